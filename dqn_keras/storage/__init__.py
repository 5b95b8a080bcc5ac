"""What is kept on disk: checkpoints, what they are known by, networks."""
