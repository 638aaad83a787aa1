"""Simulated devices for `twin:` addresses, until the standard input ends.

Run as `python -m ladarreg_core.acquisition.simulated [JSON]`.

The argument is an object with `scene`, `seed`, `base` and `sockets`, all optional. Lines on the standard input are
requests as `TwinDevices.obey` takes them.
"""

from __future__ import annotations

import json
import signal
import sys
from functools import partial

from ladarreg_core.acquisition.mount_fields import base_of_text
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from ladarreg_core.acquisition.simulated.server import TwinServer
from ladarreg_core.acquisition.simulated.world import Bench
from ladarreg_core.errors import LadarregError


def main() -> int:
    """Serve devices; print their addresses as one line of JSON."""
    options = json.loads(sys.argv[1]) if len(sys.argv) > 1 else {}
    scene, seed = str(options.get("scene", "office")), int(options.get("seed", 0))
    base = base_of_text(str(options.get("base", "upright")))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program, whose end ends the devices
    try:
        bench = Bench(scene, seed, room_from_world=base)
        serve = partial(TwinServer, sockets=bool(options.get("sockets")))
        with TwinDevices(scene, seed, serve=serve, bench=bench) as devices:
            sys.stdout.write(json.dumps({"devices": devices.addresses, "control": devices.listen()}) + "\n")
            sys.stdout.flush()
            while line := sys.stdin.readline():
                devices.obey(line)
    except LadarregError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
