"""Studies that fly or solve by other tools: Orekit, scocp."""
