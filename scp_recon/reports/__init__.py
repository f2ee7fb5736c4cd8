"""Write the report: one HTML file that shows plans and works without a network.

`subject` reads, `shown` flies, `charts`, `scene`, `ground` and `tables` draw, `page` puts together,
`write` writes; `command_charts` are pictures of commands.
Campaigns, the api and the commands may import this folder; it imports `results` and flights.
"""
