"""Networks; the only package that knows flax."""
