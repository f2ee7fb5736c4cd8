"""Replan a flight under way: check the delivered state, and set up the rest of the flight.

`flown` predicts, `remainder` checks what is delivered and makes the mission that is left, whose burns
may move by `passes`. The api and the commands may import this folder; the api plans the rest.
"""
