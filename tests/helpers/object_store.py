"""An object store in memory, with the bucket "fleet"; run by a Python with moto. It prints its address."""

from __future__ import annotations

import sys

import boto3
from moto.server import ThreadedMotoServer

server = ThreadedMotoServer("127.0.0.1", port=0)
server.start()
host, port = server.get_host_and_port()
boto3.client("s3", endpoint_url=f"http://{host}:{port}", region_name="us-east-1").create_bucket(
    Bucket="fleet"
)
print(f"{host}:{port}", flush=True)
sys.stdin.read()
