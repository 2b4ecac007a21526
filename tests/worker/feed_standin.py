"""The process of a feed without torch: it reports that its feed is live, or does what the feed's label says.

ended    report that the source has ended, an hour ago
silent   say nothing after the first report
dies     end with status 7 after the first report
stuck    report that the newest pair it knows is an hour old
returns  the same for half a second, as of a source that was away
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from typing import Any


def tell(kind: str, **fields: object) -> None:
    try:
        print(json.dumps({"kind": kind, **fields}), flush=True)
    except BrokenPipeError:
        os._exit(0)


def main() -> None:
    order: dict[str, Any] = json.loads(sys.stdin.readline())
    word, state = order["record"]["options"].get("label"), [order["record"]["wish"]]
    with open(os.path.join(order["folder"], "patient"), "a", encoding="utf-8") as file:
        file.write(f"{os.getpid()}\n")
    tell("feed_ready", endpoint=order["endpoints"][0], device="cpu")

    def obey() -> None:
        for line in sys.stdin:
            state[0] = json.loads(line)["wish"]
        os._exit(0)

    threading.Thread(target=obey, daemon=True).start()
    began_s = time.monotonic()
    while True:
        known = {"run": "live", "pause": "paused"}[state[0]]
        report = {"state": "ended" if word == "ended" else known, "since_s": time.time() - 3600, "begins_s": 1.0}
        is_old = word == "stuck" or (word == "returns" and time.monotonic() - began_s < 0.5)
        report |= {"ends_s": time.time() - 1, "received_fps": 30.0, "model_age_s": 3600.0 if is_old else 0.2}
        tell("feed_reported", report=report)
        if word == "dies":
            os._exit(7)
        if word == "silent":
            time.sleep(3600)
        time.sleep(0.05)


if __name__ == "__main__":
    main()
