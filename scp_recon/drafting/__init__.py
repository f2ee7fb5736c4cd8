"""A first scenario for one's own site and body: where a flyby could go, and the file that says so."""
