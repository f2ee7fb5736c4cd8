"""P3 and P2 as CasADi programs for IPOPT: as printed, tuned, and by single shooting."""
