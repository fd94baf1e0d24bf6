"""Models of the toybox by themselves."""
