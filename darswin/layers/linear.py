"""The linear layer of all models."""

from torch import Tensor, nn

from darswin.ops.linear import linear


class Linear(nn.Linear):
    """`nn.Linear` by the operator `linear`, which takes the machine's faster products."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D')."""
        return linear(x, self.weight, self.bias)

    def is_itself(self) -> bool:
        """False for a subclass, and for a layer that somebody watches."""
        return type(self) is Linear and not (self._forward_hooks or self._forward_pre_hooks)
