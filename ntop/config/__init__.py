"""What a run is about: frozen sections, unknown keys are errors, units in the names."""
