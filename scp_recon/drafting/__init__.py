"""Draft a first scenario for a site and a body: design a flyby, and write the scenario file.

`draft` chooses window and limits, or takes an existing trajectory; `flyby` designs. The api and
`interop` may import this folder; it imports `mission` and below, and plans nothing.
"""
