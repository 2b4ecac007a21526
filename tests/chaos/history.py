"""What was observed of every clip, and the laws that it must obey."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

from contract.queue.interface import BEAT_PERIOD_S, LEASE_S, Event
from contract.store.store import Store
from contract.wire.job import TERMINAL_STATES, JobState
from intrasplat.names import MANIFEST
from tests.chaos.deployment import WEBHOOK_SECRET
from tests.chaos.trainer import STEPS, STEPS_MADE
from tests.receiver import Webhook

RERUN_SLACK_S = 2.0
RERUN_WITHIN_S = LEASE_S + BEAT_PERIOD_S + RERUN_SLACK_S


@dataclass
class ClipHistory:
    """One clip: who was killed where, what the caller was told, what the queue and the disk hold in the end.

    cell           (target, point) as their texts
    job_id         of the 202; None if the caller never got one
    cancel_heard   the service confirmed that a cancel was asked for
    killed_at_s    UNIX time of the kill; None where nothing is killed
    told           the webhooks that came about it; None: nobody asked for any
    scored         the scores of a job that is done were added
    restart_s      until everything that was killed answered again; counted where Valkey or all were killed
    """

    cell: tuple[str, str]
    job_id: str | None = None
    cancel_heard: bool = False
    killed_at_s: float | None = None
    restart_s: float = 0.0
    scored: bool = False
    told: list[Webhook] | None = None
    events: list[Event] = field(default_factory=list)

    @property
    def final(self) -> JobState | None:
        """The last state seen."""
        return self.events[-1].record.state if self.events else None

    @property
    def rerun_s(self) -> float | None:
        """Seconds from the kill to the start of the next attempt; None if there was none."""
        killed_at_s = self.killed_at_s
        if killed_at_s is None:
            return None
        starts_s = [event.record.started_at_s or 0.0 for event in self.events if event.record.attempt > 1]
        return min((start_s - killed_at_s for start_s in starts_s if start_s > killed_at_s), default=None)


def violations(history: ClipHistory, store: Store) -> list[str]:
    """The laws this clip breaks, in words; none if all is well."""
    if history.job_id is None:
        return ["the caller never got a 202"]
    broken = []
    states = [event.record.state for event in history.events]
    ends = [n for n, state in enumerate(states) if state in TERMINAL_STATES]
    endings = {(states[n], history.events[n].record.attempt) for n in ends}
    if not ends:
        broken.append(f"no terminal state: {[state.value for state in states]}")
    elif len(endings) != 1:
        broken.append(f"several endings: {sorted(endings)}")
    if any(state not in TERMINAL_STATES for state in states[ends[0] :] if ends):
        broken.append("it went on after its end")
    if history.cancel_heard and history.final is not JobState.CANCELLED:
        broken.append(f"a cancel was confirmed, and it ended as {history.final}")
    published = store.scene_attempts(history.job_id)
    expected = [history.events[-1].record.attempt] if history.final is JobState.DONE else []
    if published != expected:
        broken.append(f"attempts {published} are published, and {expected} should be")
    if history.final is JobState.DONE and not history.scored:
        broken.append("it is done, and its scores never came")
    if history.final is JobState.CANCELLED and store.spool_folder(history.job_id).exists():
        broken.append("it was cancelled, and its clip is still there")
    if history.final is JobState.FAILED:
        broken.append("it failed")
    if history.final is JobState.DONE and published == expected:
        manifest = store.scene_folder(history.job_id, published[0]) / MANIFEST
        made = json.loads(manifest.read_bytes())[STEPS_MADE]
        if sorted(set(made)) != list(range(STEPS)) or len(made) > STEPS:
            broken.append(f"the scene was made by the steps {made}")
    if history.told is not None:
        broken += _broken_webhooks(history.told, history.final)
    if history.rerun_s is not None and history.rerun_s > RERUN_WITHIN_S + history.restart_s:
        broken.append(f"it ran again only after {history.rerun_s:.1f} s")
    return broken


def _broken_webhooks(told: list[Webhook], final: JobState | None) -> list[str]:
    """A job that has ended is told of at least once, as it ended, under its tenant's signature; no other job is."""
    if final not in TERMINAL_STATES:
        return ["it has not ended, and a webhook says that it has"] if told else []
    broken = [] if told else ["it ended, and no webhook came"]
    for webhook in told:
        if not webhook.is_genuine(WEBHOOK_SECRET, webhook.path.removeprefix("/")):
            broken.append("the signature of its webhook is wrong")
        if webhook.document["data"]["state"] != final:
            broken.append(f"it ended as {final}, and its webhook says {webhook.document['data']['state']}")
    return broken


def orphans(store: Store, known: set[str]) -> list[Path]:
    """Folders of clips, states and scenes that belong to no known job."""
    return [
        folder
        for area in ("spool", "kept", "scenes")
        for folder in (store.data_dir / area).iterdir()
        if folder.name.split(".")[0] not in known
    ]
