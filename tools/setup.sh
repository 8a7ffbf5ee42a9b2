#!/usr/bin/env bash
# Set up everything the project needs: .venv with pinned packages and the built ROS workspace.
#
# Safe to run again, to interrupt and to start twice: what is up to date is left alone, what an
# interrupted run left behind is made anew, and a second run waits for the first. With ROS 2
# Jazzy sourced, that ROS is used; otherwise ROS comes from wheels.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=$root/.venv
workspace=$root/ros2_ws
stamps=$venv/.stamps # written last, so that a stamp means a finished stage

say() { printf 'setup: %s\n' "$*"; }

die() {
  printf 'setup: %s\n' "$*" >&2
  exit 1
}

# shellcheck source=tools/packages.sh
source "$root/tools/packages.sh"

choose_ros() {
  # A Python with the ROS wheels leaves these marks on its children; they mislead another one.
  if [ -n "${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-}" ]; then
    unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH
  fi
  unset PYTHONHOME
  case ${ROS_DISTRO:-} in
    jazzy) ros=system ;;
    '')
      ros=wheels
      unset PYTHONPATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH
      [ "$(uname -s) $(uname -m)" = 'Linux x86_64' ] ||
        die 'ROS 2 comes as wheels for Linux on x86-64 only: install ROS 2 Jazzy and source it'
      ;;
    *) die "ROS 2 $ROS_DISTRO is sourced, Jazzy is needed: source Jazzy, or use a shell without ROS" ;;
  esac
}

require() { # NAME PACKAGE COMMAND...
  "${@:3}" >/dev/null 2>&1 || die "$1 is missing: install it (Debian, Ubuntu: apt install $2)"
}

# Say why a Python cannot carry the project; nothing when it can.
python_fault() {
  # Version managers put names on PATH that fail when run.
  "$1" -c '' >/dev/null 2>&1 || { echo 'does not run'; return; }
  "$1" - "$ros" <<'EOF' 2>&1 | tail -n 1
import importlib.util as find, os, sys, sysconfig
needed = ['venv', 'ensurepip'] + (['rclpy'] if sys.argv[1] == 'system' else [])
missing = [name for name in needed if find.find_spec(name) is None]
if not (3, 11) <= sys.version_info[:2] <= (3, 13):
    print('is version {}.{}'.format(*sys.version_info[:2]))
elif missing:
    print('has no module ' + missing[0])
elif not os.path.exists(os.path.join(sysconfig.get_paths()['include'], 'Python.h')):
    print('has no Python.h')
EOF
}

find_python() {
  local candidate fault faults=
  for candidate in python3.11 python3.12 python3.13 python3; do
    python=$(command -v "$candidate") || continue
    fault=$(python_fault "$python")
    [ -n "$fault" ] || return 0
    faults="$faults; $candidate $fault"
  done
  die "no suitable Python${faults:+ (${faults#; })}: install Python 3.11, 3.12 or 3.13 with its" \
    'venv module and headers (Debian, Ubuntu: apt install python3-venv python3-dev)'
}

digest() { { printf '%s\n' "$@" && cat; } | sha256sum | cut -d' ' -f1; }

packages_digest() {
  (cd "$root" && cat constraints.txt pyproject.toml tools/{setup,packages}.sh tools/fix_ros_wheels.py) |
    digest "$root" "$ros"
}

workspace_digest() {
  (cd "$workspace" && find src -type f -not -path '*/__pycache__/*' -print0 | sort -z |
    xargs -0 sha256sum) | digest "$(packages_digest)"
}

up_to_date() { [ "$(cat "$stamps/$1" 2>/dev/null)" = "$2" ]; } # STAGE DIGEST

install_packages() {
  local extras=dev,workspace
  if up_to_date made-for "$root $ros" && "$venv/bin/python" -c '' 2>/dev/null; then
    say '1 of 4: .venv is there, bringing it up to date'
  else
    find_python
    say "1 of 4: creating .venv with $("$python" --version)"
    rm -rf "$venv" "$workspace"/{build,install,log}
    "$python" -m venv "$venv"
  fi
  rm -rf "$stamps"
  [ "$ros" = system ] || extras=$extras,ros,ros-build
  local pip=("$venv/bin/python" -m pip --disable-pip-version-check)
  "${pip[@]}" -qq install -c "$root/constraints.txt" pip setuptools
  say '2 of 4: PyTorch'
  install_torch "$venv/bin/python" --disable-pip-version-check
  say "3 of 4: packages ($(grep -c == "$root/constraints.txt") are pinned; minutes the first time; all of pip's output is in $venv/packages.log)"
  # That a package is installed for editing is meant, and needs no warning.
  PYTHONWARNINGS='ignore:Editable installation' "${pip[@]}" install -c "$root/constraints.txt" \
    --no-build-isolation -e "$root[$extras]" | tee "$venv/packages.log" | package_progress
  install_ogbench "$venv/bin/python" --disable-pip-version-check
  [ "$ros" = system ] || "$venv/bin/python" "$root/tools/fix_ros_wheels.py" "$venv"
  mkdir -p "$stamps"
  echo "$root $ros" >"$stamps/made-for"
  packages_digest >"$stamps/packages"
}

# How many packages pip has come to, and that it installs them.
package_progress() {
  local line count=0
  while IFS= read -r line; do
    case $line in
      Collecting\ * | Processing\ * | Requirement\ already*)
        count=$((count + 1))
        [ $((count % 50)) != 0 ] || say "  $count found"
        ;;
      Installing\ collected\ packages:*) say '  installing them' ;;
    esac
  done
}

# What colcon starts and finishes, and how far cmake is.
build_progress() {
  local line shown=
  while IFS= read -r line; do
    if [[ $line =~ ^(Starting|Finished|Failed) ]]; then
      say "  $line"
    elif [[ $line =~ ^\[\ *([0-9]*0%)\] && ${BASH_REMATCH[1]} != "$shown" ]]; then
      shown=${BASH_REMATCH[1]}
      say "  $shown"
    fi
  done
}

build_workspace() {
  local log=$workspace/log/setup.log
  # Left by a build that did not end: what it wrote may be half a file.
  [ ! -f "$stamps/building" ] || rm -rf "$workspace"/{build,install,log}
  rm -f "$stamps/workspace"
  # colcon copies the package of Python modules and leaves those that were renamed or removed.
  rm -rf "$workspace"/{build,install}/metagcttt{,_robots}
  touch "$stamps/building"
  mkdir -p "$workspace/log"
  say "4 of 4: building the ROS workspace (a minute or two; all its output is in $log)"
  [ "$ros" = system ] || export AMENT_PREFIX_PATH=$venv CMAKE_PREFIX_PATH=$venv
  (cd "$workspace" && PATH=$venv/bin:$PATH "$venv/bin/python" -m colcon build \
    --base-paths src --event-handlers console_direct+ --cmake-args -DCMAKE_BUILD_TYPE=Release \
    -DBUILD_TESTING=OFF "-DPython3_EXECUTABLE=$venv/bin/python") 2>&1 | tee "$log" | build_progress || {
    tail -n 60 "$log" >&2
    die "colcon could not build the ROS workspace; its log ends above and is in $log"
  }
  [ "$ros" = system ] || link_workspace
  workspace_digest >"$stamps/workspace"
  rm "$stamps/building"
}

# Make the workspace visible to .venv/bin/python with nothing sourced. The ROS wheels add every
# site-packages/ros_*.libs to the library path when Python starts.
link_workspace() {
  local install=$workspace/install site
  site=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
  ln -sfn "$install/metagcttt_interfaces/lib" "$site/ros_metagcttt_interfaces.libs"
  {
    printf '%s\n' "$install"/*/lib/python3.*/site-packages
    printf 'import os; os.environ.setdefault("AMENT_PREFIX_PATH", "%s")\n' \
      "$install/metagcttt:$install/metagcttt_interfaces:$install/metagcttt_robots:$venv"
  } >"$site/metagcttt_workspace.pth"
}

choose_ros
require flock util-linux flock --version
require make make make --version
require cmake cmake cmake --version
require "a C++ compiler (${CXX:-c++})" g++ "${CXX:-c++}" --version

exec 9>"$root/.setup.lock"
flock --nonblock 9 || { say 'another set-up is running; waiting for it' && flock 9; }

up_to_date packages "$(packages_digest)" || install_packages
up_to_date workspace "$(workspace_digest)" || build_workspace
