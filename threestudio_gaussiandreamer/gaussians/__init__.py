"""Operations on clouds of points and Gaussians: grow, densify, rank, merge, simplify, extract a
surface.
"""
