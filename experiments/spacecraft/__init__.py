"""Studies that fly plans with the simulated spacecraft."""
