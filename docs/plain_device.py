"""Device under test in lockstep over CAN, with sockets only: it stops the shaft if the disk moves too far.

It imports nothing of this project. The message layout is that of rig.dbc, the text protocol that of socketcand. It
needs a rig that runs with `--pace lockstep --can zenoh:can0 --can-socketcand 127.0.0.1:29536` and is stepped from
elsewhere:

    python plain_device.py 29536
"""

import socket
import sys
from collections.abc import Iterator

STOP_ABOVE_MM = 1.2
NODE, KEY = 7, 0x9D
COMMAND, ACKNOWLEDGE, DEVICE, DEVICE_STATE, SAMPLES_1, BLOCK, HEARTBEAT = 0x20, 0x21, 0x23, 0x24, 0x201, 0x320, 0x701
JOIN, DONE, LEAVE, SPEED = 0x0F, 0xF0, 0x33, 0x5C


def sign_frame(identifier: int, first: bytes) -> bytes:
    """Return eight bytes: the first six, the key, and a CRC-8 (SAE J1850) over identifier, first bytes and key."""
    crc = 0xFF
    for byte in identifier.to_bytes(2, "little") + first + bytes([KEY]):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return first + bytes([KEY, crc ^ 0xFF])


def main(port: int, channel: str = "can0") -> None:
    """Take part in lockstep until the disk exceeds the limit."""
    with socket.create_connection(("127.0.0.1", port)) as link:
        texts = link.makefile("rb")

        def word() -> list[str]:
            text = b""
            while not text.endswith(b">"):
                byte = texts.read(1)
                if not byte:
                    raise SystemExit("the bus was closed")
                text += byte
            return text.decode().strip("<> ").split()

        def frames() -> Iterator[tuple[int, bytes]]:
            while True:
                what, *rest = word()
                if what == "frame":
                    yield int(rest[0], 16), bytes.fromhex("".join(rest[2:]))

        def send(identifier: int, *first: bytes) -> None:
            data = sign_frame(identifier, b"".join(first))
            link.sendall(f"< send {identifier:x} 8 {' '.join(f'{byte:02x}' for byte in data)} >".encode())

        word()  # hi
        for text in (f"< open {channel} >", "< rawmode >"):
            link.sendall(text.encode())
            word()  # ok
        received = frames()
        counter = next(data[2] for identifier, data in received if identifier == HEARTBEAT)
        send(DEVICE, bytes([JOIN, NODE]), bytes(4))
        state = next(data[1] for identifier, data in received if identifier == DEVICE_STATE and data[0] == NODE)
        if state != 1:
            raise SystemExit("the rig refused the device")
        print("joined", flush=True)
        furthest_mm = 0.0
        for identifier, data in received:
            if identifier == SAMPLES_1:
                x, y = (
                    int.from_bytes(data[at : at + 2], "little", signed=True) * 0.00015491156408629442
                    + 2.5380710659898478
                    for at in (2, 4)
                )
                furthest_mm = max(furthest_mm, (x * x + y * y) ** 0.5)
            elif identifier == DEVICE_STATE and data[0] == NODE:
                raise SystemExit("the rig has removed the device")
            elif identifier == BLOCK:
                if furthest_mm > STOP_ABOVE_MM:
                    send(COMMAND, bytes([SPEED, (counter + 1) % 256]), bytes(4))  # to 0 Hz
                    time_us = next(int.from_bytes(data[2:6], "little") for one, data in received if one == ACKNOWLEDGE)
                    print(f"stopped at {time_us} us, with block {int.from_bytes(data[:4], 'little')}", flush=True)
                    send(DEVICE, bytes([LEAVE, NODE]), bytes(4))
                    next(data for one, data in received if one == DEVICE_STATE)
                    return
                send(DEVICE, bytes([DONE, NODE]), data[:4])


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
