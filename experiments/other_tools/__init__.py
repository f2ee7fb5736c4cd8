"""Studies that fly or solve by other tools: Orekit and brahe, SPICE, OpenSCvx and scocp."""
