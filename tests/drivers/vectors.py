"""Byte-exact vectors of docs/protocol.md: name -> (hexadecimal, what it must decode to)."""

FD16 = (
    "34 12 02 34 78 56 34 12 01 00 ff ff ff 7f 01 80 04 00 05 00 06 00 07 00 08 00 09 00 0a 00 0b 00 0c 00 0d 00 0e 00 "
    "0f 00 10 00 11 00 12 00 13 00 14 00 15 00 16 00 17 00 18 00 19 00 1a 00 1b 00"
)
FD24 = (
    "34 12 02 34 01 00 00 ff ff ff ff ff 7f 01 00 80 04 00 00 05 00 00 06 00 00 07 00 00 08 00 00 09 00 00 0a 00 00 "
    "0b 00 00 0c 00 00 0d 00 00 0e 00 00 0f 00 00 10 00 00 11 00 00 12 00 00 13 00 00"
)
CLASSIC = "15 00 f8 ff ff ff 02 80"
SYNC = "45 42 0f 34 e8 c5 eb 0b"
SYNC_FD = "45 42 0f 00 00 00 00 34 a7 0c 54 02"
INFO = (
    "01 01 04 02 10 01 34 00 01 00 53 52 07 00 00 00 00 00 00 00 00 00 d9 40 00 00 00 00 00 00 90 3f 00 00 00 00 00 00 "
    "00 00 00 00 00 00 c0 ff 7f 40 62 32 78 00 00 00 00 00 00 00 00 00 00 00 00 00"
)
INFO_PART_0 = "02 00 01 01 04 02 10 01"
SERIAL_BODY = "01 01 02 02 34 02 00 00 80 00 00 00 00 00 00 00 88 13 00 00 00 00 00 00 01 00 ff ff 00 01 00 00"
SERIAL_WIRE = (
    "07 01 01 02 02 34 02 01 02 80 01 01 01 01 01 01 03 88 13 01 01 01 01 01 02 01 03 ff ff 02 01 01 05 06 08 56 7a 00"
)
SLCAN_CLASSIC = "t30281500F8FFFFFF0280"
COBS = [
    ("", "01"),
    ("00", "01 01"),
    ("00 00", "01 01 01"),
    ("11 22 00 33", "03 11 22 02 33"),
    ("11 00 00 00", "02 11 01 01 01"),
    (bytes(range(1, 255)).hex(), "ff" + bytes(range(1, 255)).hex()),
    (bytes(range(1, 256)).hex(), "ff" + bytes(range(1, 255)).hex() + "02ff"),
    (bytes(range(255)).hex(), "01ff" + bytes(range(1, 255)).hex()),
]
EVERY = (FD16, FD24, CLASSIC, SYNC, SYNC_FD, INFO, INFO_PART_0, SERIAL_BODY, SERIAL_WIRE, SLCAN_CLASSIC)
