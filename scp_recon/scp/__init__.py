"""Sequential convex programming: the loop, a trial step, and the algorithms SCvx, PTR and SCvx*.

It knows subproblems and dynamics of `formulations` alone, no mission; `planning` imports it.
"""
