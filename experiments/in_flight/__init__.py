"""Studies of what a flight learns: gains, planning again, sites out of reach without."""
