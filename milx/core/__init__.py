"""The basis of all other packages: devices, batches, pytrees, checkpoints and small linear systems."""
