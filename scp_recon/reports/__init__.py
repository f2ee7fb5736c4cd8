"""Write the report: one HTML file that shows plans and works without a network.

`subject` reads, `charts`, `scene`, `ground` and `tables` show, `page` puts together, `write` writes.
Campaigns, the api and the commands may import this folder; it imports `results` and flights.
"""
