"""The two loops that play and learn: step by step in Gymnasium, or whole episodes compiled."""
