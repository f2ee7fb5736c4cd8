"""Build the spacecraft from Basilisk's modules, and simulate it; needs the extra [sim]."""
