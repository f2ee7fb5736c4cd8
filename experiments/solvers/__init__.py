"""Studies of forms, algorithms and solvers.

`cases` names methods and scenarios, `cells` solves one; `compare_solvers`, `optima` and
`sensitivity` are studies. They import the harness; sentinels and the study of feedback import them.
"""
