"""What is checked at the doors: numbers, batches, networks, environments."""
