"""Forms, algorithms, conic solvers and IPOPT compared: `python -m experiments.compare_solvers`."""
