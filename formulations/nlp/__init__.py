"""The same problems as CasADi programs for IPOPT: printed, tuned, single shooting."""
