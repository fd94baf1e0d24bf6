"""Operations on Gaussians: grow, densify, rank, merge, prune."""
