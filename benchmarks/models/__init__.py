"""The memory of published models, computed from their sizes."""
