"""Plan a mission: initial guesses, stages as data, and the loop that runs them by SCP or IPOPT.

`planner.plan` makes one plan from one start, `starts.plan_from_several` the best of several. Results,
flights, certification, passes, drafts and the api import this folder; it imports `mission` and below.
"""
