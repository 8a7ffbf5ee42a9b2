# Packages that pip alone does not get right. Sourced by setup.sh and check_wheel.sh, which define
# `say` and `root`.
# shellcheck shell=bash

# PyPI's builds of PyTorch bring gigabytes of CUDA along; the builds without are in its own index.
cpu_builds=https://download.pytorch.org/whl/cpu

has_gpu() { command -v nvidia-smi >/dev/null || [ -e /dev/nvidiactl ] || [ -e /dev/dxg ]; }

answers() { # PYTHON URL
  timeout 8 "$1" -c 'import sys, urllib.request; urllib.request.urlopen(sys.argv[1], timeout=5)' \
    "$2" >/dev/null 2>&1
}

# Install PyTorch's CPU build where there is no NVIDIA GPU. What this leaves out, or cannot get,
# comes with the other packages.
install_torch() { # PYTHON [PIP OPTION...]
  local index=$cpu_builds
  if has_gpu; then
    say 'there is an NVIDIA GPU: PyTorch comes with CUDA'
  elif ! answers "$1" "$index/torch/"; then
    say "no answer from $index: PyTorch comes from pip's own index, perhaps with CUDA"
  elif ! "$1" -m pip "${@:2}" install --no-deps --index-url "$index" \
    -c "$root/constraints.txt" torch; then
    say "no PyTorch for this Python in $index: it comes from pip's own index"
  fi
}

# From Python 3.13 on, the extra `mazes` leaves ogbench out; see pyproject.toml.
install_ogbench() { # PYTHON [PIP OPTION...]
  "$1" -c 'import sys; sys.exit(sys.version_info < (3, 13))' || return 0
  "$1" -m pip "${@:2}" install --no-deps -c "$root/constraints.txt" ogbench
}
