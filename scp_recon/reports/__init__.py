"""Write the report: one HTML file that shows plans and works without a network.

`shown` reads and flies a plan; `histories`, `charts`, `scene` and `tables` draw it, `page` puts them
together, `write` writes; `pictures` are Matplotlib's.
Campaigns, the api and the commands may import this folder; it imports `results` and flights.
"""
