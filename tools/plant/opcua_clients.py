"""Clients of the OPC UA server that subscribe to the cell's variables, in a separate process.

    python -m tools.plant.opcua_clients PORT --clients 5

It prints a line when all have subscribed, and has the lowest priority: in a plant these clients are
on different computers.
"""

from __future__ import annotations

import argparse
import asyncio
import os
from contextlib import AsyncExitStack

from asyncua import Client, ua

from cell.plant.opcua.server import OWN_URI
from tools.plant.around import UNIT

#: Variables of each client, below the unit.
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
#: Interval of notifications, ms.
INTERVAL_MS = 100.0


class _Ignores:
    """Ignores the notifications of changes."""

    def datachange_notification(self, node: object, value: object, data: object) -> None:
        pass


async def _run(port: int, clients: int) -> None:
    async with AsyncExitStack() as stack:
        for _ in range(clients):
            client = Client(f"opc.tcp://127.0.0.1:{port}", timeout=60)
            await stack.enter_async_context(client)
            own = (await client.get_namespace_array()).index(OWN_URI)
            subscription = await client.create_subscription(INTERVAL_MS, _Ignores())
            await subscription.subscribe_data_change(
                [client.get_node(ua.NodeId(f"{UNIT}.{path}", own)) for path in PATHS]
            )
        print("subscribed", flush=True)
        await asyncio.Event().wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("port", type=int)
    parser.add_argument("--clients", type=int, default=5)
    options = parser.parse_args()
    os.nice(19)
    asyncio.run(_run(options.port, options.clients))


if __name__ == "__main__":
    main()
