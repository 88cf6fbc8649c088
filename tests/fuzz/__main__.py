"""make fuzz: mutated frames and files through everything that reads what others wrote.

Example: python -m tests.fuzz --share 0.01            (1 % of 10 million frames and 100 thousand files)
         python -m tests.fuzz --only pipeline --seed 3 --batch 1177      (one batch again, to look at what it found)
"""

import argparse
import faulthandler
import random
import sys
import time
import warnings

from tests.fuzz.targets import FILE_TARGETS, FRAME_TARGETS, Target

FRAMES = {"wire": 8_000_000, "pipeline": 1_500_000, "sitl": 500_000}
FILES = {"logs": 50_000, "toml": 49_000, "command line": 1_000}
HANG_S = 60


def chance(name: str, seed: int, batch: int) -> random.Random:
    """The source of one batch: the same words, the same junk."""
    return random.Random(f"{name}/{seed}/{batch}")


def fuzz(name: str, target: Target, wanted: int, seed: int) -> tuple[int, float]:
    """(how many, seconds). Raises what the target raises, with the words that repeat the batch on stderr."""
    done, batch, began_s = 0, 0, time.monotonic()
    while done < wanted:
        faulthandler.dump_traceback_later(HANG_S, exit=True)  # a hang ends here, with where it hung
        try:
            done += target(chance(name, seed, batch))
        except BaseException:
            print(f'found: python -m tests.fuzz --only "{name}" --seed {seed} --batch {batch}', file=sys.stderr)
            raise
        finally:
            faulthandler.cancel_dump_traceback_later()
        batch += 1
    return done, time.monotonic() - began_s


def main() -> None:
    """Every target's share, a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", type=float, default=1.0, help="of the whole campaign (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=[*FRAMES, *FILES], help="one target")
    parser.add_argument("--batch", type=int, help="with --only: this batch alone")
    args = parser.parse_args()
    warnings.simplefilter("error")
    targets = {**FRAME_TARGETS, **FILE_TARGETS}
    if args.batch is not None:
        targets[args.only](chance(args.only, args.seed, args.batch))
        return
    total_s = 0.0
    for name, whole in {**FRAMES, **FILES}.items():
        if args.only not in (None, name):
            continue
        targets[name](chance(name, args.seed, -1))  # kernels are loaded, what is made once is made
        done, seconds = fuzz(name, targets[name], max(1, round(args.share * whole)), args.seed)
        total_s += seconds / done * whole
        print(f"{name:13} {done:9} of {whole:9}, {done / seconds:9.0f}/s, nothing found", flush=True)
    print(f"the whole takes {total_s / 60.0:.0f} min at this rate")


if __name__ == "__main__":
    main()
