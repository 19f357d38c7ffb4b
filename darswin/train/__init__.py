"""Training and evaluation on Lightning: `darswin fit`, `validate` and `test`."""
