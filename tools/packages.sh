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

# Install PyTorch's CPU build where there is no NVIDIA GPU; gigabytes of CUDA come there only on
# request. What this leaves out comes with the other packages.
install_torch() { # PYTHON [PIP OPTION...]
  local index=$cpu_builds pip=("$1" -m pip "${@:2}") plan
  if has_gpu; then
    say 'there is an NVIDIA GPU: PyTorch comes with CUDA'
  elif ! answers "$1" "$index/torch/"; then
    say "no answer from $index: PyTorch comes from pip's own index"
  elif "${pip[@]}" install --no-deps --index-url "$index" -c "$root/constraints.txt" torch; then
    return 0
  else
    say "no PyTorch for this Python in $index: it comes from pip's own index"
  fi
  has_gpu || [ "${METAGCTTT_CUDA:-0}" = 1 ] && return 0
  plan=$("${pip[@]}" install --dry-run -c "$root/constraints.txt" torch)
  case $plan in
    *nvidia-* | *cuda-*)
      echo "setup: pip's own index has PyTorch only with gigabytes of CUDA, and there is no NVIDIA" \
        "GPU here: make $index reachable, or accept them with METAGCTTT_CUDA=1" >&2
      return 1
      ;;
  esac
}

# From Python 3.13 on, the extra `mazes` leaves ogbench out; see pyproject.toml.
install_ogbench() { # PYTHON [PIP OPTION...]
  "$1" -c 'import sys; sys.exit(sys.version_info < (3, 13))' || return 0
  "$1" -m pip "${@:2}" install --no-deps -c "$root/constraints.txt" ogbench
}
