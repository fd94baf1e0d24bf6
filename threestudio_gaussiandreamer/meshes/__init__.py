"""Load, check and ray cast triangle meshes."""
