"""`farside batch` from and to S3, a simulated one; skipped without `pip install s3fs 'moto[server]'`."""

import io
from dataclasses import replace
from pathlib import Path

import jax
import pyarrow.parquet as pq
import pytest

from foundation.store import Store
from node.commands.batch import FAILED
from node.commands.batch_options import BatchConfig
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.node.commands.test_batch import run
from tests.node.mugs import table_frame, write_folder

s3fs, moto = pytest.importorskip("s3fs"), pytest.importorskip("moto.server")


@pytest.mark.filterwarnings("ignore")  # of theirs
def test_a_bucket_takes_and_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server = moto.ThreadedMotoServer(port=0)
    server.start()
    end_point = "http://{}:{}".format(*server.get_host_and_port())
    keys = {"AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_DEFAULT_REGION": "us-east-1"}
    for name, value in {**keys, "AWS_ENDPOINT_URL": end_point}.items():
        monkeypatch.setenv(name, value)
    try:
        s3fs.S3FileSystem().mkdir("bucket")
        logs = Store("s3://bucket/logs")
        for path in write_folder(tmp_path / "table", table_frame()).iterdir():
            logs.write(f"day/table/{path.name}", path.read_bytes())
        logs.write("cut.mcap", b"cut off")
        save_prior(tmp_path / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
        given = BatchConfig(logs=(logs.url,), out="s3://bucket/results", prior=tmp_path / "tiny.safetensors")
        assert "2 units done, 0 were there, 1 failed" in run(given)[1]
        code, text = run(given)
        assert code == FAILED and "0 units done, 3 were there, 1 failed" in text
        table = pq.read_table(io.BytesIO(Store("s3://bucket/results").read(["table.parquet"])["table.parquet"]))
        assert table["log"].to_pylist() == ["s3://bucket/logs/cut.mcap", *["s3://bucket/logs/day/table"] * 2]
        with pytest.raises(ValueError, match=r"^s3://none/results cannot be written to"):
            run(replace(given, out="s3://none/results"))
    finally:
        server.stop()
