"""P3 and P2 as CasADi programs for IPOPT: as printed, tuned, and by single shooting.

`shooting` transcribes into a `program`, `covariance` has its unknowns, `solve` calls IPOPT. Planning by
IPOPT, options and studies alone import this folder, when it is needed: CasADi takes a second.
"""
