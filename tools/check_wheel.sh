#!/usr/bin/env bash
# Build the wheel and use it as its users do: in a fresh environment, far from the repository.
#
# The smallest installation trains on an npz file, the extra `mazes` evaluates. PYTHON chooses the
# interpreter of that environment; packages come from pip's index, pinned by constraints.txt.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
unset PYTHONPATH PYTHONHOME
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_COMPILE=1 # few of the modules are used

say() { printf 'wheel: %4ds %s\n' "$SECONDS" "$*"; }

die() {
  say "$*" >&2
  exit 1
}

# shellcheck source=tools/packages.sh
source "$root/tools/packages.sh"

# Only what is in the repository, so that neither old build outputs nor loose files get in.
mkdir "$work"/{source,elsewhere}
(cd "$root" && git ls-files -z pyproject.toml LICENSE metagcttt_core sim_bridge tools |
  tar --create --null --files-from=-) | tar --extract --directory "$work/source"

"${PYTHON:-$root/.venv/bin/python}" -m venv "$work/venv"
cd "$work/elsewhere"
pip=("$work/venv/bin/python" -m pip -qq)
"${pip[@]}" wheel --no-deps -w "$work" "$work/source"
wheel=$(echo "$work"/*.whl)
say "built $(basename "$wheel"), $(du -k "$wheel" | cut -f1) KiB"

install() { # EXTRAS
  "${pip[@]}" install -c "$root/constraints.txt" "$wheel$1"
  say "installed $(basename "$wheel")$1"
}

install_torch "$work/venv/bin/python" -qq
install ''
site=$("$work/venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
tops=$(cut -d/ -f1 "$site"/metagcttt_core-*.dist-info/RECORD | sort -u | grep -v 'dist-info\|^\.\.' |
  tr '\n' ' ')
[ "$tops" = 'metagcttt_core metagcttt_tools sim_bridge ' ] || die "the wheel has $tops at its top"

"$work/venv/bin/python" - <<'PYTHON'
import numpy as np

rng = np.random.default_rng(0)
actions = rng.uniform(-1, 1, (2000, 2))
observations = 4 + 0.2 * np.cumsum(actions, axis=0)
np.savez('mine.npz', observations=observations.astype(np.float32),
         actions=actions.astype(np.float32), terminals=np.arange(2000) % 100 == 99)
PYTHON

metagcttt() {
  "$work/venv/bin/metagcttt" "$@" >>log 2>&1 || { cat log; die "failed: metagcttt $*"; }
  say "metagcttt $*"
}

refuses() { # WORDS ARGUMENT...: in one line, with these words
  ! "$work/venv/bin/metagcttt" "${@:2}" >error 2>&1 || die "works without an extra: ${*:2}"
  [ "$(wc -l <error)" = 1 ] && grep -qF "$1" error || die "metagcttt ${*:2}: $(cat error)"
}

evaluate=(evaluate --dataset mine.npz --checkpoints meta/checkpoint --budgets 0 1
  --episodes 1 --seeds 0 --processes 1)

metagcttt --help
metagcttt --version
metagcttt --tyro-print-completion bash # imports every program
metagcttt pretrain --dataset mine.npz --out base --hidden 8 --training.steps 3
metagcttt meta-train --dataset mine.npz --checkpoint base/checkpoint --out meta \
  --meta.outer-steps 2 --meta.inner-steps 2
refuses 'pip install "metagcttt-core[mazes]"' "${evaluate[@]}"
refuses 'pip install "metagcttt-core[plots]"' loss-curves --dataset mine.npz
for program in demo view evaluate-ros 'benchmark ros' 'benchmark restarts'; do
  refuses 'make setup' $program
done
install '[mazes]'
install_ogbench "$work/venv/bin/python" -qq
metagcttt "${evaluate[@]}"
[ -s out/evaluation.json ] || die 'no results'
