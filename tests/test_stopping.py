"""Signals that stop a training, in the main thread and in others."""

import signal
import threading

import pytest

from kslc_jax.training import stopping


@pytest.fixture(autouse=True)
def handlers():
    """No signal is ignored at first, and the tests leave all handlers as they were."""
    found = {number: signal.signal(number, signal.SIG_DFL) for number in stopping.SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    before = {number: signal.getsignal(number) for number in stopping.SIGNALS}
    yield
    assert {number: signal.getsignal(number) for number in stopping.SIGNALS} == before
    for number, handler in found.items():
        signal.signal(number, handler)


def test_first_signal_asks_second_interrupts():
    with stopping.stop_requests() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.requested == "SIGINT"
        signal.raise_signal(signal.SIGTERM)  # a second request within a second counts as the same
        assert stop.requested == "SIGINT"
        stop._since -= stopping.SAME_SIGNAL_SECONDS
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("name", ["SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU"])
def test_warnings_ask_and_never_interrupt(name):
    """After Slurm's SIGUSR1 comes its SIGTERM: the training still has the time to save."""
    with stopping.stop_requests() as stop:
        assert stop.requested is None
        for _ in range(3):
            signal.raise_signal(getattr(signal, name))
        assert stop.requested == name
        signal.raise_signal(signal.SIGTERM)
        stop._since -= stopping.SAME_SIGNAL_SECONDS
        signal.raise_signal(getattr(signal, name))
        assert stop.requested == name


@pytest.mark.parametrize("ignored", [signal.SIGHUP, signal.SIGINT])
def test_an_ignored_signal_stays_ignored(ignored):
    """SIGHUP under nohup; SIGINT in a job that a shell script starts in the background."""
    before = signal.signal(ignored, signal.SIG_IGN)
    try:
        with stopping.stop_requests() as stop:
            signal.raise_signal(ignored)
            assert stop.requested is None
            signal.raise_signal(signal.SIGTERM)
            assert stop.requested == "SIGTERM"
        assert signal.getsignal(ignored) == signal.SIG_IGN
    finally:
        signal.signal(ignored, before)


def test_in_another_thread_signals_stay_as_they_are():
    during = []

    def work():
        with stopping.stop_requests():
            during.extend(map(signal.getsignal, stopping.SIGNALS))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert during == [signal.getsignal(number) for number in stopping.SIGNALS]
