#!/usr/bin/env bash
# The suite under other instruction sets, thread numbers, hash seeds and random streams, and a table of how it went.
# It takes about as long as `make test` for each row: run it by hand, on a quiet machine.
#
#   tests/portability.sh                     every row
#   tests/portability.sh generic threads     these rows
#   tests/portability.sh --list              their names and settings
#
#   PYTHON=.venv/bin/python   interpreter that has the package and its development tools
#   TESTS="tests/exact"       other tests than a row's own
#   LOGS=folder               where each row's output goes; a new temporary folder unless given
#
# Ends with 1 if a row failed, with 2 if a name is unknown.
set -uo pipefail
cd "$(dirname "$0")/.."

python=${PYTHON:-.venv/bin/python}
stochastic="tests/statistical tests/exact tests/unit"
# Name | environment | tests.
rows=(
    "plain||tests"
    "scalar|ATEN_CPU_CAPABILITY=default|tests"
    "avx2|ATEN_CPU_CAPABILITY=avx2|tests"
    "generic|NUMBA_CPU_NAME=generic|tests"
    "threads|MEMCOMP_THREADS=2|tests"
    "hash1|PYTHONHASHSEED=1|tests"
    "hash2|PYTHONHASHSEED=2|tests"
)
for seed in 1 2 3 4 5 6 7 8 9 10; do
    rows+=("seed$seed|MEMCOMP_SEED=$seed|$stochastic")
done

if [[ ${1:-} == --list ]]; then
    printf '%s\n' "${rows[@]}" | column -t -s '|' -N row,environment,tests
    exit
fi
chosen=()
for row in "${rows[@]}"; do
    if (($# == 0)) || [[ " $* " == *" ${row%%|*} "* ]]; then chosen+=("$row"); fi
done
if (($# > 0 && ${#chosen[@]} != $#)); then
    echo "Unknown row among: $*. Known: ${rows[*]%%|*}" >&2
    exit 2
fi

logs=${LOGS:-$(mktemp -d)}
mkdir -p "$logs"
table=$logs/table.txt
: >"$table"
failed=0
for row in "${chosen[@]}"; do
    IFS='|' read -r name environment tests <<<"$row"
    echo "== $name: ${environment:-as it is}, ${TESTS:-$tests}"
    begin=$SECONDS
    # Words on purpose: several settings, several folders.
    # shellcheck disable=SC2086
    env OMP_NUM_THREADS=1 $environment "$python" -m pytest -q ${TESTS:-$tests} >"$logs/$name.log" 2>&1
    status=$?
    verdict=passed
    if ((status != 0)); then
        verdict="FAILED" failed=1
        grep -E '^(FAILED|ERROR)' "$logs/$name.log"
    fi
    counts=$(tail -n 1 "$logs/$name.log")
    printf '%s|%s|%d s|%s\n' "$name" "$verdict" $((SECONDS - begin)) "${counts% in *}" >>"$table"
done
echo
column -t -s '|' -N row,result,time,tests "$table"
echo "Output of each row: $logs"
exit $failed
