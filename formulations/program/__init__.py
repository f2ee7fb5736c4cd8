"""The convex program: written in CVXPY, compiled once, solved by a conic solver, proved optimal.

`model` writes and compiles, `condensed` and `lifted` set its numbers, `solvers` solve and prove.
`registry` and `scp_recon` may import this folder; it imports `rows` and below.
"""
