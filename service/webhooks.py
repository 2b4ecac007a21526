"""Webhooks: tells callers' systems that a job has ended, signed, as often as it takes.

The queue remembers what is owed (contract/queue/deliveries.py); each service lends from it and tries. Nothing is kept
here, so a service may die at any time, and one that starts goes on with what is owed.
"""

from __future__ import annotations

import asyncio
import logging
import random
import ssl
import time
import uuid
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from http.cookiejar import CookieJar, DefaultCookiePolicy

import httpx
from anyio import CapacityLimiter, to_thread
from opentelemetry.trace import SpanKind
from starlette.concurrency import run_in_threadpool

from contract.access.webhook_secrets import signature, tenant_secret
from contract.queue.deliveries import Loan
from contract.queue.interface import Queue
from contract.runtime import traces
from contract.runtime.settings import Settings
from contract.runtime.version import version
from contract.wire.errors import UnavailableError
from contract.wire.webhooks import Delivery, DeliveryStatus, DeliveryTry, JobEnded, TryFailure
from service.callbacks import LookUps, is_allowed, permitted_addresses
from service.retry_after import asked_wait_s

LOOK_PERIOD_S = 0.5
MAX_AT_ONCE, MAX_OF_TENANT = 64, 4
"""Tries under way at a time, in all and of one tenant: a receiver that does not answer holds one for TRY_S."""
MAX_CALLS = 8
"""Calls of the queue at a time: requests wait for threads of their own while the queue is away."""
TRY_S = 10.0
"""How long one try may take, from looking up the name to the head of the answer."""
CONNECT_S = 4.0
"""The same for the connection to one address: a host may have another one that answers."""
MAX_TRIES = 11
FIRST_WAIT_S, WAIT_GROWS, MAX_WAIT_S, JITTER = 5.0, 4.0, 6 * 3600.0, 0.2
"""5 s after the first try, 20 s after the second, ... 6 h after the last but one: 26 h in all, unless receivers ask for
longer waits."""

logger = logging.getLogger("intrasplat.service")


class TryFailed(Exception):
    """A try failed. status_code, retry_after_s: of the receiver's answer, if there was one, and if it asked to wait."""

    def __init__(self, failure: TryFailure, status_code: int | None = None, retry_after_s: float | None = None) -> None:
        super().__init__(failure)
        self.failure = failure
        self.status_code = status_code
        self.retry_after_s = retry_after_s


class Webhooks:
    """Delivers what the queue says is owed."""

    def __init__(self, settings: Settings, queue: Queue) -> None:
        self._settings = settings
        self._queue = queue
        self._is_away = False
        self._under_way: Counter[str] = Counter()
        """By tenant."""
        self._threads = CapacityLimiter(MAX_CALLS)
        self._look_ups = LookUps(MAX_AT_ONCE)

    async def run(self) -> None:
        """Deliver whatever is due, until cancelled."""
        self._under_way.clear()
        tls = await run_in_threadpool(ssl.create_default_context)
        timeout = httpx.Timeout(TRY_S, connect=CONNECT_S)
        limits = httpx.Limits(max_keepalive_connections=0)  # a connection belongs to the name it was made for
        no_cookies = CookieJar(DefaultCookiePolicy(allowed_domains=[]))  # receivers may share an address
        # trust_env: no proxy of the environment comes between the address that was judged and the one connected to
        async with (
            httpx.AsyncClient(verify=tls, trust_env=False, limits=limits, timeout=timeout, cookies=no_cookies) as http,
            asyncio.TaskGroup() as tries,
        ):
            while True:
                loan = None
                if self._under_way.total() < MAX_AT_ONCE:
                    full = [tenant for tenant, count in self._under_way.items() if count >= MAX_OF_TENANT]
                    loan = await to_thread.run_sync(self._lent, full, limiter=self._threads)
                if loan is None:
                    await asyncio.sleep(LOOK_PERIOD_S)
                else:
                    self._under_way[loan.tenant] += 1
                    tries.create_task(self._deliver(http, loan))

    def _lent(self, full: Collection[str]) -> Loan | None:
        """A delivery that is due; None also while the queue is away, and after a fault."""
        try:
            loan = self._queue.lend_delivery(uuid.uuid4().hex, full)
        except UnavailableError as error:
            if not self._is_away:
                logger.warning("webhooks wait for the queue: %s", error.problem)
            self._is_away = True
            return None
        except Exception:  # if one was lent, its loan runs out
            logger.exception("the queue lends no webhook by a fault of ours")
            return None
        self._is_away = False
        return loan

    async def _deliver(self, http: httpx.AsyncClient, loan: Loan) -> None:
        """Try once, and note it. What nobody foresaw ends this try alone, whose loan then runs out."""
        try:
            await self._note(loan, await self._tried(http, loan))
        except Exception:
            logger.exception("what became of a webhook is not noted", extra={"job_id": loan.delivery.job_id})
        finally:
            self._under_way[loan.tenant] -= 1

    async def _tried(self, http: httpx.AsyncClient, loan: Loan) -> Delivery:
        """The delivery after one more try."""
        began_s, job_id = time.time(), loan.delivery.job_id
        status_code = failure = retry_after_s = None
        span = traces.begin("deliver webhook", loan.trace or traces.NEW, kind=SpanKind.CLIENT, job_id=job_id)
        try:
            traces.describe(span, method="POST", host=_host_of(httpx.URL(loan.url)))
            async with asyncio.timeout(TRY_S):
                status_code = await self._post(http, loan)
        except TimeoutError:
            failure = TryFailure.TIMEOUT
        except TryFailed as error:
            failure, status_code, retry_after_s = error.failure, error.status_code, error.retry_after_s
        except Exception:
            logger.exception("a webhook was not sent by a fault of ours", extra={"job_id": job_id})
            failure = TryFailure.FAULT
        finally:
            if status_code is not None:
                traces.describe(span, status=status_code)
            if failure is not None or status_code is None:
                traces.fail(span, failure or "cancelled")
            span.end()
        tried = DeliveryTry(at_s=began_s, status_code=status_code, failure=failure, retry_after_s=retry_after_s)
        return _after(loan.delivery, tried)

    async def _note(self, loan: Loan, delivery: Delivery) -> None:
        _log(delivery)
        asked_s = delivery.tries[-1].retry_after_s or 0.0
        wait_s = wait_after(_counted(delivery), asked_s) if delivery.status is DeliveryStatus.OWED else None
        try:
            await to_thread.run_sync(self._queue.note_try, loan, delivery, wait_s, limiter=self._threads)
        except UnavailableError as error:  # the loan runs out, and the webhook is sent once more
            logger.warning("what became of a webhook is not noted: %s", error.problem, extra=_about(delivery))

    async def _post(self, http: httpx.AsyncClient, loan: Loan) -> int:
        """The status of the receiver's answer, which is one of success.

        Raises:
            TryFailed: there was none.
        """
        secret = self._settings.webhook_secret
        if secret is None or not is_allowed(loan.url, self._settings):
            raise TryFailed(TryFailure.HOST_REFUSED)
        url = httpx.URL(loan.url)
        try:
            addresses = await permitted_addresses(_host_of(url), self._settings, self._look_ups)
        except (OSError, UnicodeError):
            raise TryFailed(TryFailure.UNREACHABLE) from None
        if not addresses:
            raise TryFailed(TryFailure.ADDRESS_REFUSED)
        secrets = [each for each in (secret, self._settings.webhook_old_secret) if each]
        request = _request(loan, [tenant_secret(each, loan.tenant) for each in secrets])
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
    """Seconds from so many failed tries to the next, about: many that failed together do not come back together.

    asked_s: how long the receiver asked to be left alone, which is the least.
    """
    wait_s = min(FIRST_WAIT_S * WAIT_GROWS ** (tries - 1), MAX_WAIT_S)
    return max(wait_s * random.uniform(1 - JITTER, 1 + JITTER), asked_s * random.uniform(1, 1 + JITTER))


def _counted(delivery: Delivery) -> int:
    """How many of its tries count."""
    return len(delivery.tries) - delivery.forgiven_tries


def _after(delivery: Delivery, tried: DeliveryTry) -> Delivery:
    """The delivery with one more try."""
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


def _request(loan: Loan, secrets: Sequence[str]) -> _Request:
    """The webhook, with a signature by each secret."""
    body, now_s, event = JobEnded.of(loan.delivery).model_dump_json().encode(), int(time.time()), loan.delivery.event_id
    headers = {
        "Content-Type": "application/json",
        "User-Agent": f"intrasplat/{version()}",
        "webhook-id": event,
        "webhook-timestamp": str(now_s),
        "webhook-signature": " ".join(signature(each, event, now_s, body) for each in secrets),
    }
    return _Request(body, headers)


async def _send(http: httpx.AsyncClient, url: httpx.URL, address: str, request: _Request) -> int:
    """The status of an answer of success from that address, whose certificate must be for the URL's host.

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
    """The host as it is looked up and as certificates have it: ASCII."""
    return url.raw_host.decode()


def _is_of_tls(error: BaseException | None) -> bool:
    """Whether TLS is the cause: the certificate is not trusted, or for another name."""
    while error is not None:
        if isinstance(error, ssl.SSLError):
            return True
        error = error.__cause__ or error.__context__
    return False
