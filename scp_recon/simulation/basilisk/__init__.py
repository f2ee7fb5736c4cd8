"""Build the spacecraft from Basilisk's modules, and simulate it; needs the extra [sim].

`simulation.simulate` flies a solution with `plant` and `control`. Only the api and studies import it,
where a flight is simulated: nothing else waits for Basilisk.
"""
