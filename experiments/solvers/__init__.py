"""Studies of forms, algorithms and solvers.

`cases` names methods and scenarios; `compare_solvers` and `optima` have the studies. They import the
harness; sentinels import them.
"""
