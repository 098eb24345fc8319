"""What the handshake over Modbus has of its own: its server, and coils that are not written."""

from __future__ import annotations

import socket
import socketserver
import struct
import threading

import pytest
from pymodbus.client import ModbusTcpClient

from cell.plant.handshake.carrier import UNKNOWN, CarrierError, Inputs, Outputs
from cell.plant.handshake.modbus import ModbusCarrier
from cell.settings.plant import Handshake
from tests.waiting import free_port


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


def test_what_has_nothing_behind_it_is_an_illegal_function() -> None:
    """Registers were written with success, and read as 0."""
    said = Handshake(port=free_port())
    with ModbusCarrier(said), ModbusTcpClient("127.0.0.1", port=said.port) as plc:
        answers = [
            plc.write_register(0, 1),
            plc.write_registers(0, [1, 2]),
            plc.readwrite_registers(read_address=0, read_count=1, values=[1]),
            plc.mask_write_register(),
            plc.read_holding_registers(0),
            plc.read_input_registers(0),
            plc.read_device_information(),
        ]
        assert [a.exception_code for a in answers] == [1] * len(answers)
        assert plc.write_coils(0, [True] * 6).function_code == 15
        assert plc.read_coils(0, count=6).bits[:6] == [True] * 6


#: Requests from their function on, and the code of their exception.
WRONG = [
    ("01 0000 0000", 3),
    ("02 0000 07d1", 3),
    ("02 000f 0002", 2),
    ("05 0000 0001", 3),
    ("05 0000", 3),
    ("0f 0000 0003 02 0700", 3),
    ("0f 0000 0003 01", 3),
    ("0f 0000 0000 00", 3),
    ("0f 000f 0002 01 03", 2),
    ("00 0000", 1),
    ("2b 0e 01 00", 1),
]


def test_requests_in_one_packet_are_all_answered_and_wrong_ones_with_their_code() -> None:
    """Of two requests in a packet only the first was answered."""
    said = Handshake(port=free_port())
    with ModbusCarrier(said), socket.create_connection(("127.0.0.1", said.port), 20.0) as plc:
        asked = [bytes.fromhex(text) for text, _ in WRONG]
        asked += [bytes.fromhex("0f 0000 0006 01 21"), bytes.fromhex("01 0000 0006")]
        packet = b"".join(
            struct.pack(">HHHB", number, 0, len(pdu) + 1, 7) + pdu
            for number, pdu in enumerate(asked)
        )
        plc.sendall(packet[:-3])
        plc.sendall(packet[-3:])
        wanted = [
            bytes([pdu[0] | 0x80, code]) for pdu, (_, code) in zip(asked, WRONG, strict=False)
        ]
        wanted += [bytes.fromhex("0f 0000 0006"), bytes.fromhex("01 01 21")]
        with plc.makefile("rb") as answers:
            for number, pdu in enumerate(wanted):
                head = struct.unpack(">HHHB", answers.read(7))
                assert head == (number, 0, len(pdu) + 1, 7)
                assert answers.read(len(pdu)) == pdu


@pytest.mark.parametrize("said_", ["0000 0001 0006 07 01 0000 0006", "0000 0000 0001 07"])
def test_what_is_no_modbus_ends_the_connection(said_: str) -> None:
    said = Handshake(port=free_port())
    with ModbusCarrier(said), socket.create_connection(("127.0.0.1", said.port), 20.0) as plc:
        plc.sendall(bytes.fromhex(said_))
        assert plc.recv(10) == b""


def test_it_listens_at_once_however_late_its_thread_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy computer it said that it cannot listen, though it listened."""
    said = Handshake(port=free_port())
    late = threading.Event()
    serve = socketserver.ThreadingTCPServer.serve_forever
    monkeypatch.setattr(
        socketserver.ThreadingTCPServer,
        "serve_forever",
        lambda self, poll_s: late.wait(20.0) and serve(self, poll_s),
    )
    with ModbusCarrier(said), socket.create_connection(("127.0.0.1", said.port), 20.0) as plc:
        plc.sendall(bytes.fromhex("0001 0000 0006 07 01 0000 0006"))
        late.set()
        assert plc.recv(10) == bytes.fromhex("0001 0000 0004 07 01 01 00")
