"""The passes of a multilayer perceptron in plain tensor operations, for the processor."""

import math

import torch
from torch import Tensor

from metagcttt_core.agents.networks import MLP

# GELU in its tanh form is z sigmoid(u) with u = z (a + b z^2): a sigmoid costs a tenth of a tanh.
_A = 2 * math.sqrt(2 / math.pi)
_B = 0.044715 * _A
# Below so many multiplications oneDNN's call costs more than the BLAS library's slower product.
_SMALL_PRODUCT = 1_500_000
_OPS = torch.ops.mkldnn if torch.backends.mkldnn.is_available() else None


class Passes:
    """Forward and backward pass of an MLP, written out, in memory that is kept between calls.

    Autograd is left out, activations are fused by hand, and float32 products go to oneDNN, which
    is never slower than the BLAS library in PyTorch and twice as fast on AMD's processors.

    Attributes:
        gradients: Those of the last `backward`, one for each parameter, in the MLP's order.
    """

    def __init__(self, mlp: MLP, *, dtype: torch.dtype = torch.float32) -> None:
        """Prepare passes with the weights that `mlp` has at each call.

        Args:
            mlp: On the processor, in float32.
            dtype: Of the operands of matrix products; all else is float32.
        """
        self._eps: list[float] = []
        self._hidden: list[list[Tensor]] = []  # weight, bias and those of the layer norm
        for index in range(mlp.num_hidden):
            layers = [mlp.get_submodule(f'fc{index}')]
            if mlp.layer_norm:
                layers.append(mlp.get_submodule(f'ln{index}'))
            self._hidden.append([w.detach() for layer in layers for w in layer.parameters()])
        self._head = [w.detach() for w in mlp.get_submodule(mlp.head_name).parameters()]
        self._norm = mlp.layer_norm
        layers_of = [*self._hidden, self._head]
        by_layer = [[torch.zeros_like(w) for w in layer] for layer in layers_of]
        self._by_layer = by_layer
        self.gradients = [gradient for layer in by_layer for gradient in layer]
        self._dtype = dtype
        self._weights: list[Tensor] = []
        self._inputs: list[Tensor] = []  # of each linear layer, as the products read them
        self._saved: list[tuple[Tensor, ...]] = []
        self._buffers: list[_Buffers] = []

    def forward(self, inputs: Tensor) -> Tensor:
        """Map (B, in_dim) to (B, out_dim), in float32."""
        if not self._buffers or len(self._buffers[0].slope) != len(inputs):
            self._buffers = [_Buffers(len(inputs), len(layer[0])) for layer in self._hidden]
        self._weights = [layer[0].to(self._dtype) for layer in (*self._hidden, self._head)]
        self._inputs, self._saved = [], []
        x = inputs
        for weight, layer, buffers in zip(
            self._weights, self._hidden, self._buffers, strict=False
        ):
            self._inputs.append(x.to(self._dtype))
            z = product(self._inputs[-1], weight, layer[1]).to(torch.float32)
            x = buffers.gelu(z)
            if self._norm:
                width = [x.shape[1]]
                x, mean, rstd = torch.native_layer_norm(x, width, layer[2], layer[3], 1e-6)
                self._saved.append((mean, rstd))
        self._inputs.append(x.to(self._dtype))
        return product(self._inputs[-1], self._weights[-1], self._head[1]).to(torch.float32)

    def backward(self, gradient: Tensor, *, weights: bool = True, inputs: bool = False) -> Tensor:
        """Take the gradient of the last forward pass's outputs (B, out_dim) back.

        Args:
            gradient: Of a loss with respect to the outputs.
            weights: Set `gradients`.
            inputs: Go on to the inputs.

        Returns:
            With `inputs` the gradient with respect to them, (B, in_dim).
        """
        g = gradient
        for index in range(len(self._weights) - 1, -1, -1):
            into = self._by_layer[index]
            if weights:
                torch.sum(g, 0, out=into[1])
            g = g.to(self._dtype)
            if weights:
                _weight_gradient(g, self._inputs[index], into[0])
            if not index and not inputs:
                break
            g = product(g, self._weights[index].t()).to(torch.float32)
            if index:
                layer, buffers = self._hidden[index - 1], self._buffers[index - 1]
                if self._norm:
                    g, scale, shift = torch.ops.aten.native_layer_norm_backward(
                        g,
                        buffers.activation,
                        [g.shape[1]],
                        *self._saved[index - 1],
                        layer[2],
                        layer[3],
                        [True, weights, weights],
                    )
                    if weights:
                        self._by_layer[index - 1][2].copy_(scale)
                        self._by_layer[index - 1][3].copy_(shift)
                g = buffers.gelu_backward(g)
        return g


class _Buffers:
    """What the activation of one layer keeps for its backward pass, each (B, units)."""

    def __init__(self, rows: int, units: int) -> None:
        self.activation, self.sigmoid, self.factor, self.slope = torch.empty(4, rows, units)
        self._a = torch.full((rows, units), _A)

    def gelu(self, z: Tensor) -> Tensor:
        torch.addcmul(self._a, z, z, value=_B, out=self.factor)  # u / z
        torch.mul(z, self.factor, out=self.sigmoid).sigmoid_()
        return torch.mul(z, self.sigmoid, out=self.activation)

    def gelu_backward(self, gradient: Tensor) -> Tensor:
        """`gradient` times s + z s (1 - s) du/dz; du/dz = 3 u / z - 2 a."""
        s, h = self.sigmoid, self.activation
        curve = torch.addcmul(h, h, s, value=-1, out=self.slope)
        s.addcmul_(curve, self.factor, value=3).sub_(curve, alpha=2 * _A)
        return torch.mul(s, gradient, out=self.slope)


def product(left: Tensor, right: Tensor, bias: Tensor | None = None) -> Tensor:
    """Left (n, k) times the transpose of right (m, k), plus a bias (m,), by the faster library."""
    small = len(left) * len(right) * left.shape[1] < _SMALL_PRODUCT
    if small or _OPS is None or left.dtype != torch.float32:
        if bias is None:
            return torch.mm(left, right.t())
        return torch.addmm(bias.to(left.dtype), left, right.t())
    return _OPS._linear_pointwise(left, right, bias, 'none', [], '')


def _weight_gradient(gradient: Tensor, inputs: Tensor, into: Tensor) -> None:
    """Write gradient (B, m) transposed times inputs (B, n) into (m, n)."""
    # oneDNN copies its left operand to turn it: the smaller one.
    if gradient.shape[1] <= inputs.shape[1]:
        into.copy_(product(gradient.t(), inputs.t()))
    else:
        into.copy_(product(inputs.t(), gradient.t()).t())
