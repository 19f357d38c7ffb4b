"""Training and evaluation on Lightning: `darswin fit`, `validate`, `test` and `predict`."""
