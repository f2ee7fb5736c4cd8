"""Certify plans: nonlinear flights must reach the required probability.

`certify` raises the target until they do, `flights` flies its rounds and tests, `largest` searches for
the largest target, `again` corrects drifts and pictures. The api and `impulsive` may import this
folder; it calls planning as a function that is given.
"""
