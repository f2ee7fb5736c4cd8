"""Compare forms, algorithms, conic solvers and IPOPT: `python -m experiments compare_solvers`."""
