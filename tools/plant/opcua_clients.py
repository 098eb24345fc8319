"""Clients of the OPC UA server that subscribe to what the cell shows, in a process of their own.

    python -m tools.plant.opcua_clients PORT --clients 5 --interval-ms 100 [--items 10000]

It prints a line when all have subscribed, and computes after everybody else: in a plant these
clients are on other computers.
"""

from __future__ import annotations

import argparse
import asyncio
import os
from contextlib import AsyncExitStack
from itertools import cycle, islice

from asyncua import Client, ua

from cell.plant.opcua.server import OWN_URI

#: What each client looks at, below the unit.
PATHS = (
    "Cell.Connected",
    "Cell.State",
    "Cell.Step",
    "Cell.Cycle",
    "Cell.Part",
    "Cell.Counts.Inserted",
    "Cell.Seconds.Execute",
    "Cell.LastResult.Outcome",
    "Cell.LastResult.Margin",
    "Cell.Fault.Cause",
    "Status.StateCurrent",
    "Admin.ProdConsumedCount",
)
#: Items of a subscription, as clients make them.
_ITEMS = 500


class _Counted:
    """Counts what it is told."""

    changes = 0

    def datachange_notification(self, node: object, value: object, data: object) -> None:
        _Counted.changes += 1


async def _subscribe(client: Client, name: str, interval_ms: float, items: int) -> None:
    own = (await client.get_namespace_array()).index(OWN_URI)
    nodes = [client.get_node(ua.NodeId(f"{name}.{path}", own)) for path in PATHS]
    left = items
    while left > 0:
        subscription = await client.create_subscription(interval_ms, _Counted())
        await subscription.subscribe_data_change(islice(cycle(nodes), min(_ITEMS, left)))
        left -= _ITEMS


async def _run(port: int, name: str, clients: int, interval_ms: float, items: int) -> None:
    async with AsyncExitStack() as stack:
        for _ in range(clients):
            client = Client(f"opc.tcp://127.0.0.1:{port}", timeout=60)
            await stack.enter_async_context(client)
            await _subscribe(client, name, interval_ms, items // clients)
        print("subscribed", flush=True)
        await asyncio.Event().wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("port", type=int)
    parser.add_argument("--name", default="Cell", help="of the unit: plant.opcua.name")
    parser.add_argument("--clients", type=int, default=5)
    parser.add_argument("--interval-ms", type=float, default=100.0)
    parser.add_argument("--items", type=int, help="of all clients; default: every tag once each")
    options = parser.parse_args()
    os.nice(19)
    items = options.clients * len(PATHS) if options.items is None else options.items
    asyncio.run(_run(options.port, options.name, options.clients, options.interval_ms, items))


if __name__ == "__main__":
    main()
