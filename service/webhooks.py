"""Webhooks: sends callers' systems a signed message when a job has ended, and retries failed deliveries.

The queue stores the pending deliveries (contract/queue/deliveries.py). Each service claims due ones and attempts them.
Nothing is stored here, so a service may die at any time, and the next one continues.
"""

from __future__ import annotations

import asyncio
import logging
import random
import re
import ssl
import time
import uuid
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http.cookiejar import CookieJar, DefaultCookiePolicy

import httpx
from anyio import CapacityLimiter, to_thread
from opentelemetry.trace import SpanKind
from starlette.concurrency import run_in_threadpool

from contract.access.webhook_secrets import signature, tenant_secret
from contract.queue.deliveries import ClaimedDelivery
from contract.queue.interface import Queue
from contract.runtime import traces
from contract.runtime.settings import Settings
from contract.wire.webhooks import Delivery, DeliveryStatus, DeliveryTry, JobEnded, TryFailure
from intrasplat.errors import UnavailableError
from intrasplat.version import version
from service.callbacks import LookUps, is_allowed, permitted_addresses

LOOK_PERIOD_S = 0.5
MAX_AT_ONCE, MAX_OF_TENANT = 64, 4
"""Maximum attempts at a time, in total and per tenant. A receiver that does not answer occupies one for TRY_S."""
MAX_CALLS = 8
"""Maximum calls to the queue at a time, so that webhooks leave threads to requests while the queue is unreachable."""
TRY_S = 10.0
"""How long one attempt may take, from the DNS look-up to the head of the answer."""
CONNECT_S = 4.0
"""How long connecting to one address may take: another address of the host may answer."""
MAX_TRIES = 11
FIRST_WAIT_S, WAIT_GROWS, MAX_WAIT_S, JITTER = 5.0, 4.0, 6 * 3600.0, 0.2
"""Waits of 5 s after the first attempt, 20 s after the second, ... 6 h before the last: 26 h in total, unless receivers
request longer waits."""
ASKS_TO_WAIT = frozenset({httpx.codes.TOO_MANY_REQUESTS, httpx.codes.SERVICE_UNAVAILABLE})

logger = logging.getLogger("intrasplat.service")


class TryFailed(Exception):
    """An attempt failed. status_code, retry_after_s: from the receiver's answer, if there was one."""

    def __init__(self, failure: TryFailure, status_code: int | None = None, retry_after_s: float | None = None) -> None:
        super().__init__(failure)
        self.failure = failure
        self.status_code = status_code
        self.retry_after_s = retry_after_s


class Webhooks:
    """Sends the pending webhooks of the queue."""

    def __init__(self, settings: Settings, queue: Queue) -> None:
        self._settings = settings
        self._queue = queue
        self._is_away = False
        self._in_progress: Counter[str] = Counter()
        """Attempts in progress, by tenant."""
        self._threads = CapacityLimiter(MAX_CALLS)
        self._look_ups = LookUps(MAX_AT_ONCE)

    async def run(self) -> None:
        """Send all due webhooks, until cancelled."""
        self._in_progress.clear()
        tls = await run_in_threadpool(ssl.create_default_context)
        timeout = httpx.Timeout(TRY_S, connect=CONNECT_S)
        limits = httpx.Limits(max_keepalive_connections=0)  # never reuse a connection for another host name
        no_cookies = CookieJar(DefaultCookiePolicy(allowed_domains=[]))  # receivers may share an address
        # trust_env: with a proxy of the environment, the service would not connect to the address that it has checked
        async with (
            httpx.AsyncClient(verify=tls, trust_env=False, limits=limits, timeout=timeout, cookies=no_cookies) as http,
            asyncio.TaskGroup() as tries,
        ):
            while True:
                claim = None
                if self._in_progress.total() < MAX_AT_ONCE:
                    full = [tenant for tenant, count in self._in_progress.items() if count >= MAX_OF_TENANT]
                    claim = await to_thread.run_sync(self._claim_due, full, limiter=self._threads)
                if claim is None:
                    await asyncio.sleep(LOOK_PERIOD_S)
                else:
                    self._in_progress[claim.tenant] += 1
                    tries.create_task(self._deliver(http, claim))

    def _claim_due(self, full: Collection[str]) -> ClaimedDelivery | None:
        """Claim a due delivery; None if there is none, the queue is unreachable, or the call failed."""
        try:
            claim = self._queue.claim_delivery(uuid.uuid4().hex, full)
        except UnavailableError as error:
            if not self._is_away:
                logger.warning("webhooks wait for the queue: %s", error.problem)
            self._is_away = True
            return None
        except Exception:  # if a delivery was claimed, the claim expires
            logger.exception("a fault while a webhook was claimed")
            return None
        self._is_away = False
        return claim

    async def _deliver(self, http: httpx.AsyncClient, claim: ClaimedDelivery) -> None:
        """Attempt a delivery once and store the result. After an unexpected error its claim expires."""
        try:
            await self._note(claim, await self._tried(http, claim))
        except Exception:
            logger.exception("the result of a webhook was not stored", extra={"job_id": claim.delivery.job_id})
        finally:
            self._in_progress[claim.tenant] -= 1

    async def _tried(self, http: httpx.AsyncClient, claim: ClaimedDelivery) -> Delivery:
        """Attempt a delivery. Returns it with the new attempt."""
        began_s, job_id = time.time(), claim.delivery.job_id
        status_code = failure = retry_after_s = None
        span = traces.begin("deliver webhook", claim.trace or traces.NEW, kind=SpanKind.CLIENT, job_id=job_id)
        try:
            traces.describe(span, method="POST", host=_host_of(httpx.URL(claim.url)))
            async with asyncio.timeout(TRY_S):
                status_code = await self._post(http, claim)
        except TimeoutError:
            failure = TryFailure.TIMEOUT
        except TryFailed as error:
            failure, status_code, retry_after_s = error.failure, error.status_code, error.retry_after_s
        except Exception:
            logger.exception("a fault while a webhook was sent", extra={"job_id": job_id})
            failure = TryFailure.FAULT
        finally:
            if status_code is not None:
                traces.describe(span, status=status_code)
            if failure is not None or status_code is None:
                traces.fail(span, failure or "cancelled")
            span.end()
        tried = DeliveryTry(at_s=began_s, status_code=status_code, failure=failure, retry_after_s=retry_after_s)
        return _after(claim.delivery, tried)

    async def _note(self, claim: ClaimedDelivery, delivery: Delivery) -> None:
        _log(delivery)
        asked_s = delivery.tries[-1].retry_after_s or 0.0
        wait_s = wait_after(_counted(delivery), asked_s) if delivery.status is DeliveryStatus.OWED else None
        try:
            await to_thread.run_sync(self._queue.record_try, claim, delivery, wait_s, limiter=self._threads)
        except UnavailableError as error:  # the claim expires, and the webhook is sent again
            logger.warning("the result of a webhook was not stored: %s", error.problem, extra=_about(delivery))

    async def _post(self, http: httpx.AsyncClient, claim: ClaimedDelivery) -> int:
        """Send the webhook. Returns the status of the receiver's successful answer.

        Raises:
            TryFailed: no address gave a successful answer.
        """
        secret = self._settings.webhook_secret
        if secret is None or not is_allowed(claim.url, self._settings):
            raise TryFailed(TryFailure.HOST_REFUSED)
        url = httpx.URL(claim.url)
        try:
            addresses = await permitted_addresses(_host_of(url), self._settings, self._look_ups)
        except (OSError, UnicodeError):
            raise TryFailed(TryFailure.UNREACHABLE) from None
        if not addresses:
            raise TryFailed(TryFailure.ADDRESS_REFUSED)
        secrets = [each for each in (secret, self._settings.webhook_old_secret) if each]
        request = _request(claim, [tenant_secret(each, claim.tenant) for each in secrets])
        failed = TryFailed(TryFailure.UNREACHABLE)
        for address in addresses:
            try:
                return await _send(http, url, address, request)
            except httpx.ConnectError as error:  # the next address may answer
                failed = TryFailed(TryFailure.CERTIFICATE if _is_of_tls(error) else TryFailure.UNREACHABLE)
            except httpx.TimeoutException:
                failed = TryFailed(TryFailure.TIMEOUT)
            except httpx.HTTPError:
                failed = TryFailed(TryFailure.UNREACHABLE)
        raise failed


def wait_after(tries: int, asked_s: float = 0.0) -> float:
    """Seconds from the last of `tries` failed attempts to the next, with jitter so that retries spread out.

    asked_s: the wait that the receiver requested; the result is never less.
    """
    wait_s = min(FIRST_WAIT_S * WAIT_GROWS ** (tries - 1), MAX_WAIT_S)
    return max(wait_s * random.uniform(1 - JITTER, 1 + JITTER), asked_s * random.uniform(1, 1 + JITTER))


def _counted(delivery: Delivery) -> int:
    """How many of the delivery's attempts count."""
    return len(delivery.tries) - delivery.forgiven_tries


def _after(delivery: Delivery, tried: DeliveryTry) -> Delivery:
    """The delivery with one more attempt."""
    after = delivery.model_copy(update={"tries": (*delivery.tries, tried)})
    status = DeliveryStatus.OWED
    if tried.failure is None:
        status = DeliveryStatus.DELIVERED
    elif tried.status_code == httpx.codes.GONE or _counted(after) >= MAX_TRIES:
        status = DeliveryStatus.FAILED
    return after.model_copy(update={"status": status})


def _log(delivery: Delivery) -> None:
    failure = delivery.tries[-1].failure
    if delivery.status is DeliveryStatus.FAILED:
        logger.error("a webhook was given up after %d tries: %s", len(delivery.tries), failure, extra=_about(delivery))
    elif failure is not None:
        logger.warning("a webhook was not delivered and is tried again: %s", failure, extra=_about(delivery))
    else:
        logger.info("a webhook was delivered", extra=_about(delivery))


def _about(delivery: Delivery) -> dict[str, object]:
    code = delivery.tries[-1].status_code
    return {"job_id": delivery.job_id} | ({} if code is None else {"status": code})


@dataclass(frozen=True)
class _Request:
    body: bytes
    headers: dict[str, str]


def _request(claim: ClaimedDelivery, secrets: Sequence[str]) -> _Request:
    """The HTTP request of a webhook, with a signature by each secret."""
    body, now_s, event = (
        JobEnded.of(claim.delivery).model_dump_json().encode(),
        int(time.time()),
        claim.delivery.event_id,
    )
    headers = {
        "Content-Type": "application/json",
        "User-Agent": f"intrasplat/{version()}",
        "webhook-id": event,
        "webhook-timestamp": str(now_s),
        "webhook-signature": " ".join(signature(each, event, now_s, body) for each in secrets),
    }
    return _Request(body, headers)


async def _send(http: httpx.AsyncClient, url: httpx.URL, address: str, request: _Request) -> int:
    """Send to one address, whose certificate must be for the URL's host. Returns the status of a successful answer.

    Only the head of the answer is read, and no redirect is followed.
    """
    headers = {"Host": url.netloc.decode(), **request.headers}
    extensions = {"sni_hostname": _host_of(url)}
    at = url.copy_with(host=address)
    async with http.stream("POST", at, content=request.body, headers=headers, extensions=extensions) as answer:
        if not answer.is_success:
            raise TryFailed(TryFailure.STATUS, answer.status_code, asked_wait_s(answer, MAX_WAIT_S))
        return answer.status_code


def _host_of(url: httpx.URL) -> str:
    """The host in ASCII, as in DNS and in certificates."""
    return url.raw_host.decode()


def _is_of_tls(error: BaseException | None) -> bool:
    """Whether TLS is the cause: the certificate is not trusted, or is for another name."""
    while error is not None:
        if isinstance(error, ssl.SSLError):
            return True
        error = error.__cause__ or error.__context__
    return False


def asked_wait_s(answer: httpx.Response, most_s: float) -> float | None:
    """The wait that an answer's Retry-After (RFC 9110) requests, at most most_s; None if it has no readable one."""
    text = answer.headers.get("retry-after", "")
    if answer.status_code not in ASKS_TO_WAIT:
        return None
    if re.fullmatch(r"\d+", text, re.ASCII):
        return min(float(text), most_s)
    try:
        at = parsedate_to_datetime(text)
    except (ValueError, OverflowError):
        return None
    at = at if at.tzinfo else at.replace(tzinfo=UTC)  # HTTP dates are UTC, even without a zone
    return max(0.0, min((at - datetime.now(UTC)).total_seconds(), most_s))
