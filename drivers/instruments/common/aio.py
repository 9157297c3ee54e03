"""Asyncio forms of the drivers: the same calls, run on one thread per instrument."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Concatenate, Generic, ParamSpec, Protocol, Self, TypeVar, cast

from drivers.instruments.common.driver import Instrument, Sampler
from drivers.link import Link
from drivers.sources.samples import Samples, StreamEndedError

D = TypeVar("D", bound=Instrument)
S = TypeVar("S", bound=Sampler)
P = ParamSpec("P")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)


class AsyncMethod(Protocol[P, R_co]):
    """A method that returns a coroutine, for type checkers: not all of them bind a plain callable to its object."""

    def __get__(self, instance: object, owner: type | None = None, /) -> Callable[P, Coroutine[Any, Any, R_co]]:
        """Return the method of one object."""
        ...


def make_async(method: Callable[Concatenate[Any, P], R]) -> AsyncMethod[P, R]:
    """Return a driver's method as a coroutine method of its asyncio form."""

    @functools.wraps(method)
    async def call(self: AsyncInstrument[Any], *args: P.args, **keywords: P.kwargs) -> R:
        return await self._run(functools.partial(method, self.driver, *args, **keywords))

    return cast(AsyncMethod[P, R], call)


class AsyncInstrument(Generic[D]):
    """Asyncio form of a driver.

    Calls run one after another, in the order in which they were awaited. A cancelled call is still finished on its
    thread, at the latest after its time-out.

    Args:
        driver: The driver; `close` closes it too.
    """

    DRIVER: ClassVar[type[Instrument]]

    def __init__(self, driver: D) -> None:
        self.driver = driver
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"{driver.CODEC.address.name} driver")

    @classmethod
    async def open(cls, url: str, *, timeout_s: float = 3.0) -> Self:
        """Connect to the instrument at a URL; arguments and errors as for `Instrument.open`."""
        return cls(await asyncio.to_thread(cls.DRIVER.open, url, timeout_s=timeout_s))

    @classmethod
    def from_link(cls, link: Link, *, timeout_s: float = 3.0) -> Self:
        """Return the instrument at the end of an open link."""
        return cls(cls.DRIVER(link, timeout_s=timeout_s))

    identify = make_async(Instrument.identify)

    async def _run(self, call: Callable[[], R]) -> R:
        return await asyncio.get_running_loop().run_in_executor(self._thread, call)

    async def close(self) -> None:
        """Close the link; further calls have no effect."""
        await asyncio.to_thread(self.driver.close)
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class AsyncSampler(AsyncInstrument[S]):
    """Asyncio form of a measuring instrument."""

    configure = make_async(Sampler.configure)
    start = make_async(Sampler.start)
    stop = make_async(Sampler.stop)
    read = make_async(Sampler.read)

    async def blocks(self, rows: int | None = None, *, timeout_s: float = 5.0) -> AsyncIterator[Samples]:
        """Yield blocks of `rows` rows to the end of the stream."""
        while True:
            try:
                samples = await self.read(rows, timeout_s=timeout_s)
            except StreamEndedError:
                return
            yield samples
