"""Draft a first scenario for a site and a body: design a flyby, and write the scenario file."""
