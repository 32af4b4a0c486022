"""How good a policy is, and the files and plots that say so."""
