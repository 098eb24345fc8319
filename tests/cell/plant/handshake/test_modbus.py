"""What the handshake over Modbus has of its own: its server, and coils that are not written."""

from __future__ import annotations

import pytest
from pymodbus.client import ModbusTcpClient

from cell.plant.handshake.carrier import CarrierError
from cell.plant.handshake.modbus import ModbusCarrier
from cell.plant.handshake.signals import UNKNOWN, Inputs, Outputs
from cell.settings.plant.handshake import Handshake
from tests.cell.plant.handshake.conftest import free_port


def test_bits_have_their_numbers_and_each_has_to_be_written() -> None:
    said = Handshake.model_validate(
        {
            "port": free_port(),
            "inputs": {"stop": {"number": 40, "inverted": True}, "part_present": None},
            "outputs": {"fault": {"number": 20, "inverted": True}},
        }
    )
    with ModbusCarrier(said) as carrier, ModbusTcpClient("127.0.0.1", port=said.port) as plc:
        with pytest.raises(CarrierError, match="writes nothing for 1 s"):
            carrier.read()
        plc.write_coils(0, [True, False, False, False, False], device_id=1)
        with pytest.raises(CarrierError, match="has not written coil 40 yet"):
            carrier.read()
        plc.write_coil(40, True, device_id=1)
        assert carrier.read() == Inputs(start=True, upstream_ready=False, downstream_ready=False)
        plc.write_coil(40, False, device_id=1)
        assert carrier.read().stop
        carrier.write(Outputs(ready=True, done=True))
        bits = plc.read_discrete_inputs(0, count=21, device_id=1).bits
        assert [number for number in range(21) if bits[number]] == [0, 2, 20]
        carrier.write(UNKNOWN)
        bits = plc.read_discrete_inputs(0, count=21, device_id=1).bits
        assert not any(bits[:21])
        assert plc.write_coil(500, True, device_id=1).isError()


def test_a_port_that_is_taken_is_said() -> None:
    said = Handshake(port=free_port())
    with ModbusCarrier(said), pytest.raises(CarrierError, match=f"listen at 127.0.0.1:{said.port}"):
        ModbusCarrier(said).__enter__()
