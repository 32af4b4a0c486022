"""What every layer above builds on: devices, batches, pytrees, checkpoints, small linear algebra."""
