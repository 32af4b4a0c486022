"""Meta-training: updates, runs, and what keeps them safe."""
