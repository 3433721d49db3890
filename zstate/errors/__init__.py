"""Every exception of zstate, as one tree.

ZStateError
├── InvalidInput (ValueError)          an argument that cannot be used; nothing was changed
│   ├── FrameMismatch                  ``a_from_b @ c_from_d`` with b != c
│   ├── InsertRefused                  the buffer did not take a transform        .reason .edge
│   └── ConfigError                    a configuration file or option             .path
├── ModelError (ValueError)            a robot model that cannot be used          .source .findings
│   └── UnknownModel                   no model of that name                      .name .near_misses
├── LibraryMissing (ImportError)       something to install first
├── MessageError (ValueError)          bytes on our keys that are not ours        .reason
├── SecondWriter                       somebody else writes the same already      .first .robot .stream .edge
├── RecordingError                     a file that cannot be read or written      .path
├── NetworkError                       Zenoh said no
│   ├── Unreachable (TimeoutError)     nothing answers at the endpoints           .endpoints
│   ├── AccessDenied                   somebody answers, and lets nobody in       .reason .endpoint
│   ├── NoClock (TimeoutError)         nobody tells the simulated time            .waited_s
│   ├── PortBusy                       somebody listens there already             .endpoint
│   └── Closed                         used after close(), or after fork
└── LookupFailed                       .target .source .edge .requested .oldest .newest .track .rate_hz ...
    ├── UnknownFrame                   never heard of it                          .name .near_misses
    ├── AmbiguousFrame                 a bare name that several robots have       .name .candidates
    ├── Disconnected                   two trees                                  .roots .gone_s
    ├── ClockMismatch                  stamps of two clocks on one path           .edges .robots .domains
    ├── NoData                         an edge without any sample
    ├── InFuture                       asked after the newest sample of an edge
    ├── InPast                         asked before the oldest sample of an edge
    ├── Stale                          too old for ``max_age_s``, or silent       .age_s .max_age_s .other
    └── NotFinite                      numbers too large to compute with

A wait that ran out raises the reason it was still waiting for, as a subclass that is also
``WaitTimeout`` (a TimeoutError): ``except InFuture`` and ``except TimeoutError`` both catch it.
"""

from zstate._util.format import format_duration
from zstate.errors.base import (
    AccessDenied,
    Closed,
    ConfigError,
    FindingLike,
    FrameMismatch,
    InsertRefused,
    InvalidInput,
    LibraryMissing,
    MessageError,
    ModelError,
    NetworkError,
    NoClock,
    PortBusy,
    RecordingError,
    SecondWriter,
    UnknownModel,
    Unreachable,
    WriterLike,
    ZStateError,
    printable,
)
from zstate.errors.lookup import (
    AmbiguousFrame,
    ClockMismatch,
    Disconnected,
    InFuture,
    InPast,
    LookupFailed,
    NoData,
    NotFinite,
    Stale,
    UnknownFrame,
    WaitTimeout,
    as_timeout,
)

__all__ = [
    "AccessDenied",
    "AmbiguousFrame",
    "ClockMismatch",
    "Closed",
    "ConfigError",
    "Disconnected",
    "FindingLike",
    "FrameMismatch",
    "InFuture",
    "InPast",
    "InsertRefused",
    "InvalidInput",
    "LibraryMissing",
    "LookupFailed",
    "MessageError",
    "ModelError",
    "NetworkError",
    "NoClock",
    "NoData",
    "NotFinite",
    "PortBusy",
    "RecordingError",
    "SecondWriter",
    "Stale",
    "UnknownFrame",
    "UnknownModel",
    "Unreachable",
    "WaitTimeout",
    "WriterLike",
    "ZStateError",
    "as_timeout",
    "format_duration",
    "printable",
]
