"""The passes of a multilayer perceptron without autograd, for the processor."""

from abc import ABC, abstractmethod
from contextlib import suppress
import ctypes
from functools import cache
import math
from pathlib import Path
import re

import torch
from torch import Tensor
from torch.nn import functional

from metagcttt_core.agents.networks import MLP
from metagcttt_core.kernels import Kernels, Layer

# GELU in its tanh form is z sigmoid(u) with u = z (a + b z^2): a sigmoid costs a tenth of a tanh.
_A = 2 * math.sqrt(2 / math.pi)
_B = 0.044715 * _A
# Up to so many multiplications in a product, Python between layers costs more than oneDNN gains.
_ONE_CALL = 2**24
# Rows that are evaluated at a time, so that what lies between the layers stays in the cache.
_BLOCK = 128
# Below so many multiplications oneDNN's call costs more than the BLAS library's slower product.
_SMALL_PRODUCT = 1_500_000
_OPS = torch.ops.mkldnn if torch.backends.mkldnn.is_available() else None


class Passes(ABC):
    """Forward and backward pass of an MLP, written out, in memory that is kept between calls.

    Autograd is left out, activations are fused by hand, and float32 products go to oneDNN, which
    is never slower than the BLAS library in PyTorch and twice as fast on some of AMD's.

    Attributes:
        gradients: Those of the last `backward`, one for each parameter, in the MLP's order.
        out_dim: Width of the outputs.
    """

    def __init__(self, mlp: MLP, *, dtype: torch.dtype = torch.float32) -> None:
        """Prepare passes with the weights that `mlp` has at each call.

        Args:
            mlp: On the processor, in float32.
            dtype: Of the operands of matrix products; all else is float32.
        """
        self._norm = mlp.layer_norm
        names = [f'fc{index}' for index in range(mlp.num_hidden)]
        by_layer = [[name, name.replace('fc', 'ln')] if self._norm else [name] for name in names]
        # Weight, bias and those of the layer norm; of each hidden layer and the head.
        self._layers = [
            [w.detach() for name in layer for w in mlp.get_submodule(name).parameters()]
            for layer in (*by_layer, [mlp.head_name])
        ]
        self._by_layer = [[torch.zeros_like(w) for w in layer] for layer in self._layers]
        self.gradients = [gradient for layer in self._by_layer for gradient in layer]
        self.out_dim = len(self._layers[-1][0])
        self._dtype = dtype
        self._rows = 0
        self._weights: list[Tensor] = []
        self._inputs: list[Tensor] = []  # of each linear layer, as the products read them

    def forward(self, inputs: Tensor) -> Tensor:
        """Map (B, in_dim) to (B, out_dim), in float32."""
        if len(inputs) != self._rows:
            self._rows = len(inputs)
            self._make_room()
        self._weights = [layer[0].to(self._dtype) for layer in self._layers]
        self._inputs = [inputs.to(self._dtype)]
        for index in range(len(self._layers) - 1):
            self._inputs.append(self._hidden(index, self._inputs[-1]).to(self._dtype))
        return product(self._inputs[-1], self._weights[-1], self._layers[-1][1]).to(torch.float32)

    def evaluate(self, inputs: Tensor) -> Tensor:
        """As `forward` without a backward pass to come; what the last `forward` keeps stays."""
        x = inputs.to(self._dtype)
        for index, layer in enumerate(self._layers[:-1]):
            x = self._activated(index, product(x, layer[0].to(self._dtype))).to(self._dtype)
        weight, bias = self._layers[-1]
        return product(x, weight.to(self._dtype), bias).to(torch.float32)

    def backward(self, gradient: Tensor, *, weights: bool = True, inputs: bool = False) -> Tensor:
        """Take the gradient of the last forward pass's outputs (B, out_dim) back.

        Args:
            gradient: Of a loss with respect to the outputs.
            weights: Set `gradients`.
            inputs: Go on to the inputs.

        Returns:
            With `inputs` the gradient with respect to them, (B, in_dim), else `gradient`.
        """
        g = gradient
        if weights:
            torch.sum(g, 0, out=self._by_layer[-1][1])
        for index in reversed(range(len(self._layers))):
            g = g.to(self._dtype)
            if weights:
                _weight_gradient(g, self._inputs[index], self._by_layer[index][0])
            if not index and not inputs:
                return gradient
            g = product(g, self._weights[index].t()).to(torch.float32)
            if index:
                g = self._hidden_backward(index - 1, g, weights)
        return g

    @abstractmethod
    def _make_room(self) -> None:
        """Allocate what the passes of `self._rows` rows need."""

    @abstractmethod
    def _hidden(self, index: int, inputs: Tensor) -> Tensor:
        """The outputs of a hidden layer, (B, units) float32."""

    @abstractmethod
    def _activated(self, index: int, product: Tensor) -> Tensor:
        """What a hidden layer makes of its product, (B, units) float32; nothing is kept."""

    @abstractmethod
    def _hidden_backward(self, index: int, gradient: Tensor, weights: bool) -> Tensor:
        """Take a gradient back to the layer's product; set those of all but the kernel."""


class TensorPasses(Passes):
    """Passes in tensor operations."""

    def _make_room(self) -> None:
        self._saved: list[tuple[Tensor, ...]] = [()] * len(self._layers)
        self._buffers = [_Buffers(self._rows, len(layer[0])) for layer in self._layers[:-1]]

    def _hidden(self, index: int, inputs: Tensor) -> Tensor:
        layer = self._layers[index]
        z = product(inputs, self._weights[index], layer[1]).to(torch.float32)
        x = self._buffers[index].gelu(z)
        if self._norm:
            x, *saved = torch.native_layer_norm(x, [x.shape[1]], layer[2], layer[3], 1e-6)
            self._saved[index] = tuple(saved)
        return x

    def _activated(self, index: int, product: Tensor) -> Tensor:
        layer = self._layers[index]
        z = product.to(torch.float32) + layer[1]
        x = torch.mul(z, z).mul_(_B).add_(_A).mul_(z).sigmoid_().mul_(z)
        if self._norm:
            x = functional.layer_norm(x, [x.shape[1]], layer[2], layer[3], 1e-6)
        return x

    def _hidden_backward(self, index: int, gradient: Tensor, weights: bool) -> Tensor:
        g, into, buffers = gradient, self._by_layer[index], self._buffers[index]
        if self._norm:
            g, scale, shift = torch.ops.aten.native_layer_norm_backward(
                g,
                buffers.activation,
                [g.shape[1]],
                *self._saved[index],
                *self._layers[index][2:],
                [True, weights, weights],
            )
            if weights:
                into[2].copy_(scale)
                into[3].copy_(shift)
        g = buffers.gelu_backward(g)
        if weights:
            torch.sum(g, 0, out=into[1])
        return g


class FusedPasses(Passes):
    """Passes whose activations are one kernel each; in float32, a whole pass is one call."""

    def __init__(self, mlp: MLP, kernels: Kernels, *, dtype: torch.dtype = torch.float32) -> None:
        """As `Passes`, by `kernels`."""
        super().__init__(mlp, dtype=dtype)
        self._kernels = kernels
        self._structs = (Layer * len(self._layers))()
        fields = ('weight', 'bias', 'scale', 'shift')
        for struct, layer, slopes in zip(self._structs, self._layers, self._by_layer, strict=True):
            struct.outputs, struct.inputs = layer[0].shape
            for field, weight, slope in zip(fields, layer, slopes, strict=False):
                setattr(struct, field, weight.data_ptr())
                setattr(struct, f'{field}_slope', slope.data_ptr())
        self._network = (self._kernels.sgemm, ctypes.addressof(self._structs), len(self._structs))
        self._by_blas = dtype == torch.float32 and _blas_keeps_up()
        self._widest = max(struct.outputs for struct in self._structs)
        self._room = torch.empty(2 * (_BLOCK + 1) * self._widest)

    def forward(self, inputs: Tensor) -> Tensor:
        """See `Passes`."""
        if len(inputs) != self._rows:
            self._rows = len(inputs)
            self._make_room()
        if not self._at_once:
            return super().forward(inputs)
        self._inputs = [inputs.contiguous()]
        outputs = torch.empty(self._rows, self.out_dim)
        self._kernels.forward(
            *self._network, self._rows, self._inputs[0].data_ptr(), outputs.data_ptr()
        )
        return outputs

    def evaluate(self, inputs: Tensor) -> Tensor:
        """See `Passes`."""
        if not self._by_blas:
            return super().evaluate(inputs)
        inputs = inputs.contiguous()
        outputs = torch.empty(len(inputs), self.out_dim)
        self._kernels.evaluate(
            *self._network,
            len(inputs),
            inputs.data_ptr(),
            outputs.data_ptr(),
            _BLOCK,
            self._widest,
            self._room.data_ptr(),
        )
        return outputs

    def backward(self, gradient: Tensor, *, weights: bool = True, inputs: bool = False) -> Tensor:
        """See `Passes`."""
        if not self._at_once:
            return super().backward(gradient, weights=weights, inputs=inputs)
        gradient = gradient.contiguous()
        into = torch.empty_like(self._inputs[0]) if inputs else None
        self._kernels.backward(
            *self._network,
            self._rows,
            self._inputs[0].data_ptr(),
            gradient.data_ptr(),
            None if into is None else into.data_ptr(),
            weights,
        )
        return gradient if into is None else into

    def _make_room(self) -> None:
        largest = max(layer[0].numel() for layer in self._layers)
        self._at_once = self._by_blas and self._rows * largest <= _ONE_CALL
        self._outputs = []
        self._kept = []
        for struct in self._structs[:-1]:
            room = torch.empty(3 if self._norm else 2, self._rows, struct.outputs)
            inverse_std = torch.empty(self._rows)
            struct.output, struct.gelu_slope = room[0].data_ptr(), room[1].data_ptr()
            if self._norm:
                struct.normed, struct.inverse_std = room[2].data_ptr(), inverse_std.data_ptr()
            self._outputs.append(room[0])
            self._kept.append((room, inverse_std))

    def _hidden(self, index: int, inputs: Tensor) -> Tensor:
        struct = self._structs[index]
        output = product(inputs, self._weights[index]).to(torch.float32)
        self._outputs[index], struct.output = output, output.data_ptr()
        self._kernels.activate(ctypes.addressof(struct), self._rows)
        return output

    def _activated(self, index: int, product: Tensor) -> Tensor:
        struct, output = ctypes.addressof(self._structs[index]), product.to(torch.float32)
        self._kernels.activate_only(struct, len(output), output.data_ptr(), self._room.data_ptr())
        return output

    def _hidden_backward(self, index: int, gradient: Tensor, weights: bool) -> Tensor:
        struct = ctypes.addressof(self._structs[index])
        self._kernels.activate_backward(struct, self._rows, gradient.data_ptr(), weights)
        return gradient


def passes_of(mlp: MLP, dtype: torch.dtype, kernels: Kernels | None) -> Passes:
    """Passes of `mlp` with products in `dtype`, by kernels where there are any."""
    if kernels is None:
        return TensorPasses(mlp, dtype=dtype)
    return FusedPasses(mlp, kernels, dtype=dtype)


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


@cache
def _blas_keeps_up() -> bool:
    """False where oneDNN's products are twice as fast as the BLAS library's.

    On AMD's processors with a vector unit of 512 bits (Zen 5, family 26) the latter uses half of
    it. Looked up, not timed: two processes on one machine must round alike.
    """
    if _OPS is None:
        return True
    with suppress(OSError):
        facts = Path('/proc/cpuinfo').read_text()
        family = re.search(r'^cpu family\s*: (\d+)$', facts, re.MULTILINE)
        return 'AuthenticAMD' not in facts or family is None or int(family[1]) < 26
    return True


def _weight_gradient(gradient: Tensor, inputs: Tensor, into: Tensor) -> None:
    """Write gradient (B, m) transposed times inputs (B, n) into (m, n)."""
    if gradient.dtype == torch.float32 and _blas_keeps_up():
        torch.mm(gradient.t(), inputs, out=into)
        return
    # oneDNN copies its left operand to turn it: the smaller one.
    if gradient.shape[1] <= inputs.shape[1]:
        into.copy_(product(gradient.t(), inputs.t()))
    else:
        into.copy_(product(inputs.t(), gradient.t()).t())
