"""Fit the body to what cameras saw: landmarks, then silhouettes; all frames of an actor at once."""
