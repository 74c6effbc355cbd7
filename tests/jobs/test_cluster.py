"""Workers: local ones, those of a scheduler, and the processes in which they work."""

import os
import pickle
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from drake_pose import version
from drake_pose.errors import ClusterError
from drake_pose.jobs.cluster import (
    address_of,
    call_in_child,
    open_cluster,
    require_fit_workers,
    worker_facts,
)
from tests.cli import run_to_end


def test_scheduler_and_workers_listen_on_the_loopback_address(cluster):
    this = psutil.Process()
    listening = [
        connection.laddr.ip
        for process in [this, *this.children(recursive=True)]
        for connection in process.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    ]
    assert len(listening) >= 3
    assert all(ip.startswith("127.") for ip in listening)
    assert list(cluster.nthreads().values()) == [1, 1]
    with open_cluster(scheduler=address_of(cluster)) as client:
        assert address_of(client) == address_of(cluster)
        require_fit_workers(client, Path(os.curdir))


def fleet(*facts, error=None):
    """Stand in for a client of workers with these facts."""

    def run(function, file):
        if error is not None:
            raise error
        own = function(file)
        return {f"w{k}": (*one, *own[len(one) :]) for k, one in enumerate(facts)}

    def wait(count, timeout):
        if len(facts) < count:
            raise TimeoutError

    return SimpleNamespace(
        run=run, wait_for_workers=wait, nthreads=lambda: [*facts], scheduler=None
    )


@pytest.mark.parametrize(
    ("client", "words"),
    [
        (fleet((), ("99.0",)), "the worker w1 has drake_pose 99.0, but here is"),
        (fleet((version.VERSION, "abc")), "another development version"),
        (fleet((*worker_facts()[:2], False)), "does not see the folder"),
        (fleet(), "the scheduler at its address has no workers"),
        (fleet((), error=ImportError("none")), r"cannot use drake_pose \(none\)"),
    ],
)
def test_unfit_workers_are_refused(client, words, tmp_path):
    with pytest.raises(ClusterError, match=words):
        require_fit_workers(client, tmp_path)


def test_fit_workers_see_the_folder_which_is_left_empty(tmp_path):
    require_fit_workers(fleet((), ()), tmp_path / "a" / "new")
    require_fit_workers(fleet(()), tmp_path / "a" / "new")
    assert list((tmp_path / "a" / "new").iterdir()) == []
    assert not worker_facts(tmp_path / "none")[2]
    (tmp_path / "file").touch()
    with pytest.raises(ClusterError, match="cannot be written"):
        require_fit_workers(fleet(()), tmp_path / "file")


@pytest.mark.parametrize("words", [b"", b"HTTP/1.0 400 Bad request\r\n\r\n" * 8])
def test_a_server_that_is_not_a_scheduler_is_refused_in_time(words):
    with socket.create_server(("127.0.0.1", 0)) as listening:
        talk = threading.Thread(target=lambda: listening.accept()[0].sendall(words), daemon=True)
        talk.start()
        address = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        begin = time.monotonic()
        cluster = open_cluster(scheduler=address, timeout=0.5)
        with pytest.raises(ClusterError, match=address), cluster:
            pass
        assert time.monotonic() - begin < 5.0


@pytest.mark.parametrize("address", ["foo", "10.0.0.7:8786", "tcp://foo", "htp://x:1"])
def test_a_bad_scheduler_address_is_named(address):
    message = f"'{address}' is not a scheduler's address"
    with pytest.raises(ClusterError, match=message), open_cluster(scheduler=address):
        pass


def test_a_cluster_needs_dask_and_a_worker(tmp_path, out, monkeypatch):
    with pytest.raises(ClusterError, match="one worker or more"), open_cluster(0):
        pass
    monkeypatch.setattr("drake_pose.jobs.cluster.find_spec", lambda _: None)
    path = tmp_path / "jobs.yaml"
    path.write_text("scenes: {gone: {scene: gone}}")
    words = ["batch", path, "--out", out]
    refused = run_to_end(*words, "--workers", "2", status=1)
    assert 'pip install "drake_pose[cluster]"' in refused.stderr
    assert not out.exists()
    done = run_to_end(*words, status=1)
    assert 'one process does all the work; to use all cores: pip install "dr' in done.stderr
    assert "scene 'gone'" in done.stderr


def test_a_crash_ends_the_child_and_not_the_worker():
    def call(function, argument):
        return pickle.loads(call_in_child(pickle.dumps((function, argument))))

    pid = "__import__('os').getpid()"
    child = call(os.getpgid, 0), call(eval, pid)
    assert child == (os.getpgid(0), call(eval, pid))
    assert child[1] != os.getpid()
    for function, argument, how in (
        (os._exit, 3, "exit status 3"),
        (os._exit, 0, "exit status 0"),
        (eval, "__import__('os').kill(__import__('os').getpid(), 9)", "SIGKILL"),
    ):
        with pytest.raises(ClusterError, match=how):
            call(function, argument)
    assert call(eval, pid) not in (os.getpid(), child[1])
