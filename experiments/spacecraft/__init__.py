"""Studies that fly plans by the spacecraft."""
