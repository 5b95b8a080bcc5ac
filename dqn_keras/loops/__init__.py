"""The two loops that play and learn: step by step in Gymnasium, or in compiled programs of whole episodes."""
