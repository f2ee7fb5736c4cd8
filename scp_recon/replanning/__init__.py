"""Replan a flight under way: check the delivered state, and set up the rest of the flight.

`flown` predicts, `delivery` checks, `remainder` is the mission that is left, whose burns may move by
`passes`. The api and the commands may import this folder; the rest itself is planned by the api.
"""
