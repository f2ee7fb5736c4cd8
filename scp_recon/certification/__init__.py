"""Certify plans: nonlinear flights must reach the required probability.

`certify` raises the target until they do, `largest` searches for the largest target, `targets` lets
plans for several targets start each other, `again` corrects drifts and pictures. The api and
`impulsive` may import this folder; it calls planning as a function that is given.
"""
