"""A planar arm that touches one of three cubes."""
