"""Runs a plan file on the drives of a CAN bus, after a confirmation.

    python examples/run_on_can.py rig.yaml plan.json --channel can0
    python examples/run_on_can.py rig.yaml plan.json --simulated     # no bus: rehearse it first

Read docs/safety.md and docs/commissioning.md before you power the drives.
"""

import argparse
import sys

import cdpr


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rig")
    parser.add_argument("plan")
    parser.add_argument("--interface", default="socketcan", help="python-can's name")
    parser.add_argument("--channel", default="can0")
    parser.add_argument("--camera", help="index of the camera; default: no measurement")
    parser.add_argument("--simulated", action="store_true", help="drives in this process")
    options = parser.parse_args(arguments)

    def confirm(proposal: object) -> bool:
        return options.simulated or input("Is the room clear? Move now? [y/N] ") == "y"

    try:
        rig, plan = cdpr.load_rig(options.rig), cdpr.load_plan(options.plan)
        if options.simulated:
            rig = rig.with_bus("virtual")
        else:
            rig = rig.with_bus(options.interface, options.channel)
            state = cdpr.status(rig)  # moves nothing
            print(state)
            if state.missing is not None:
                raise state.missing
        run = cdpr.run(
            plan,
            rig,
            cameras=[options.camera] if options.camera else [],
            realtime=not options.simulated,
            confirm=confirm,
            on_event=print,
        )
    except cdpr.CdprError as error:  # refused before anything moved, or drives do not answer
        print(error, file=sys.stderr)
        return error.exit_code
    print(run.verdict, "-", run.sentence)
    return run.exit_code


if __name__ == "__main__":
    sys.exit(main())
