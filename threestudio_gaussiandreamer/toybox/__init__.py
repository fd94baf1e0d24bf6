"""Generated objects with prompts, and the training of small text-to-3D models on them."""
