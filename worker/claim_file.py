"""Store a worker's claim in a file: if the worker is killed, the next one of its name gives the job back at once.

Without the file the job would wait until the lease expires. Only one worker of a name runs on a data directory.
"""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path

from contract.queue.interface import Claim, Queue
from intrasplat.errors import UnavailableError

logger = logging.getLogger("intrasplat.worker")


class ClaimFile:
    """The claim file of one worker. It only saves time: if it cannot be used, the lease expires instead."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def note(self, claim: Claim) -> None:
        """Store the claim that the worker holds from now on."""
        try:
            self._path.write_text(json.dumps(asdict(claim)))
        except OSError as error:
            logger.warning("the claim was not noted: %s", error.strerror)

    def forget(self) -> None:
        """Remove the file: the worker holds no claim."""
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            logger.warning("the noted claim was not removed: %s", error.strerror)

    def give_back(self, queue: Queue) -> bool:
        """Release the claim of an earlier, killed process, and count a death of its job; False if there was none."""
        try:
            claim = Claim(**json.loads(self._path.read_text()))
        except (OSError, ValueError, TypeError):
            return False
        try:
            given_back = queue.release(claim, died=True)
        except UnavailableError as error:
            logger.warning("the job of an earlier process was not given back: %s", error.problem)
            return False
        self.forget()
        if given_back:
            logger.warning("an earlier process of this name was killed; its job %s is handed back", claim.job_id)
        return given_back
