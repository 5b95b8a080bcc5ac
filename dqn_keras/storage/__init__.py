"""Files on disk: checkpoints, the identity of a run, networks."""
