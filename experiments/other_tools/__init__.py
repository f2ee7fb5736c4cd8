"""Studies that fly or solve by other tools: Orekit and brahe, SPICE, scocp."""
