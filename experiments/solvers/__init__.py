"""Studies of forms, algorithms and solvers.

`cases` names methods and scenarios; `compare_solvers`, `optima` and `sensitivity` are studies. They
import the harness; sentinels import them.
"""
