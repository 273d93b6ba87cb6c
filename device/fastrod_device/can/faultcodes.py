"""Meaning of a drive's numbers: emergency codes (CiA 301, CiA 402 and those of an EPOS4) and states of the
drive, in words."""

from __future__ import annotations

CODES: dict[int, str] = {
    0x0000: "no error",
    0x1000: "generic error",
    0x1080: "generic initialisation error",
    0x1090: "firmware does not fit the hardware",
    0x2310: "over-current",
    0x2320: "power stage protection",
    0x3210: "over-voltage",
    0x3220: "under-voltage",
    0x4210: "power stage too hot",
    0x4380: "motor too hot",
    0x5113: "logic supply too low",
    0x5280: "hardware defect",
    0x5281: "hardware does not fit the firmware",
    0x6080: "sign of life missing",
    0x6081: "extension 1 watchdog",
    0x6100: "software error inside the drive",
    0x6320: "software parameter error",
    0x6380: "persistent parameters corrupt",
    0x7320: "position sensor error",
    0x7380: "position sensor breach",
    0x7381: "position sensor resolution error",
    0x7382: "position sensor index error",
    0x7388: "Hall sensor error",
    0x7389: "Hall sensor not found",
    0x738A: "Hall angle detection error",
    0x738C: "SSI sensor error",
    0x738D: "SSI sensor frame error",
    0x7390: "missing main sensor",
    0x7391: "missing commutation sensor",
    0x7392: "main sensor turns the wrong way",
    0x8110: "CAN overrun, messages were lost",
    0x8111: "CAN overrun, messages were lost",
    0x8120: "CAN passive mode, many errors on the line",
    0x8130: "no heartbeat of the master",
    0x8140: "recovered from bus-off",
    0x8150: "transmit COB-ID collides",
    0x81FD: "CAN bus-off",
    0x81FE: "CAN receive queue overflow",
    0x81FF: "CAN transmit queue overflow",
    0x8210: "PDO too short, not processed",
    0x8250: "RPDO timeout",
    0x8280: "EtherCAT PDO communication error",
    0x8611: "following error",
    0x8A80: "negative limit switch",
    0x8A81: "positive limit switch",
    0x8A82: "software position limit",
    0x8A88: "safe torque off",
    0xFF01: "system overloaded",
    0xFF02: "watchdog of the drive",
    0xFF0B: "system peak overloaded",
    0xFF10: "controller gains out of range",
    0xFF11: "auto tuning could not identify the motor",
    0xFF12: "auto tuning hit its current limit",
    0xFF13: "auto tuning: speed is not constant",
    0xFF14: "auto tuning interrupted",
}
"""Emergency codes in words."""

_CLASSES = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current at the input",
    0x22: "current inside the drive",
    0x23: "current at the output",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the drive",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "temperature around the drive",
    0x42: "temperature of the drive",
    0x43: "temperature of the motor",
    0x50: "hardware of the drive",
    0x51: "supply of the drive",
    0x52: "hardware of the drive",
    0x60: "software of the drive",
    0x61: "software inside the drive",
    0x62: "user software",
    0x63: "parameters",
    0x70: "additional modules",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x83: "torque control",
    0x84: "velocity control",
    0x85: "position control",
    0x86: "position control",
    0x8A: "limits",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "of the maker's own",
}


def in_words(code: int) -> str:
    """An emergency code in words, by its class where the code itself is not known.

    >>> in_words(0x8611)
    'following error (0x8611)'
    >>> in_words(0x2345)
    'current at the output (0x2345)'
    """
    known = CODES.get(code) or _CLASSES.get(code >> 8) or _CLASSES.get((code >> 8) & 0xF0) or "unknown error"
    return f"{known} (0x{code:04X})"


NOT_READY = "not ready to switch on"
SWITCH_ON_DISABLED = "switch on disabled"
READY = "ready to switch on"
SWITCHED_ON = "switched on"
ENABLED = "operation enabled"
QUICK_STOP = "quick stop active"
REACTION = "fault reaction active"
FAULT = "fault"

STATUS_BITS = {
    NOT_READY: 0x00,
    SWITCH_ON_DISABLED: 0x40,
    READY: 0x21,
    SWITCHED_ON: 0x23,
    ENABLED: 0x27,
    QUICK_STOP: 0x07,
    REACTION: 0x0F,
    FAULT: 0x08,
}
"""Statusword of each state, bits 0 to 3, 5 and 6."""


def _decode(word: int) -> str:
    low = word & 0x4F
    if low in (0x00, 0x40, 0x08, 0x0F):  # bit 5 says nothing in these
        return {0x00: NOT_READY, 0x40: SWITCH_ON_DISABLED, 0x08: FAULT, 0x0F: REACTION}[low]
    return {0x21: READY, 0x23: SWITCHED_ON, 0x27: ENABLED, 0x07: QUICK_STOP}.get(word & 0x6F, NOT_READY)


_STATES = tuple(_decode(word) for word in range(128))


def state_in_words(statusword: int) -> str:
    """State of the drive (CiA 402) that a statusword tells.

    >>> state_in_words(0x1637)
    'operation enabled'
    """
    return _STATES[statusword & 0x7F]
