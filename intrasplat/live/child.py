"""`python -m intrasplat.live.child`: the process that reads an untrusted source.

It loads its libraries, reads one request as JSON from stdin, confines itself, and only then reads the source. Further
lines on stdin: {"want": number, "after": sequence} asks for the newest pair after `sequence`; {"end": true} for the
end. It answers in lines of JSON, each with all numbers so far, so that one that is left out is no loss; a pair lies in
the file that it inherited when its line comes: left eye, then right eye, RGB. The last line has {"end": reason}.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path


def main() -> None:
    """Read the request, confine this process, and read the source. It ends without one if its parent ends."""
    descriptor = os.dup(1)
    os.dup2(2, 1)  # libraries' output must not mix with the answers
    import av.logging

    from intrasplat.decode.guard import Allowance, lock_in
    from intrasplat.live.reader import Answers, Reader

    line = sys.stdin.buffer.readline()
    if not line:
        return
    request = json.loads(line)
    av.logging.set_level(None)
    source = request["open"]
    readable = [Path(each) for each in source.get("readable", ())]
    devices = [Path(source["device"])] if "device" in source else []
    lock_in(Allowance(**request["allowance"]), readable, Path.cwd(), devices, source.get("port"))
    if os.getppid() != request["parent"]:  # the parent ended before lock_in could register for its death
        return
    answers = Answers(descriptor)
    threading.excepthook = lambda raised: answers.fail(raised.exc_value)
    try:
        Reader(request, answers).run()
    except Exception as error:
        answers.fail(error)


if __name__ == "__main__":
    main()
