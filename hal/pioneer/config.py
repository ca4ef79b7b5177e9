"""CONFIGpac: what the firmware knows of its robot. No I/O.

Field order: Pioneer 3 Operations Manual, "CONFIGpac contents". Speeds in mm/s and deg/s,
accelerations in mm/s² and deg/s², times in ms, voltages in 0.1 V.
"""

from __future__ import annotations

from dataclasses import dataclass

from visctrl.hal.pioneer.fields import Fields, coded
from visctrl.hal.pioneer.packet import Packet
from visctrl.hal.pioneer.reports import ReportError, Type

#: Simulators write this where a real controller has its hardest limit.
UNLIMITED = 9999


@dataclass(frozen=True)
class Config(Fields):
    """The robot's FLASH parameters; fields that the firmware does not send are None."""

    robot_type: str = coded("z")
    subclass: str = coded("z")
    serial_number: str = coded("z")
    four_motors: int | None = coded("B")
    turn_top: int | None = coded("H")
    speed_top: int | None = coded("H")
    turn_acceleration_top: int | None = coded("H")
    acceleration_top: int | None = coded("H")
    pwm_max: int | None = coded("H")
    name: str | None = coded("z")
    report_cycle: int | None = coded("B")
    host_baud: int | None = coded("B")
    aux1_baud: int | None = coded("B")
    gripper: int | None = coded("H")
    front_sonar: int | None = coded("H")
    rear_sonar: int | None = coded("B")
    low_battery: int | None = coded("H")
    rev_count: int | None = coded("H")
    watchdog: int | None = coded("H")
    p2_packets: int | None = coded("B")
    stall_value: int | None = coded("H")
    stall_count: int | None = coded("H")
    joystick_speed: int | None = coded("H")
    joystick_turn: int | None = coded("H")
    turn_max: int | None = coded("H")
    speed_max: int | None = coded("H")
    turn_acceleration: int | None = coded("H")
    turn_deceleration: int | None = coded("H")
    turn_kp: int | None = coded("H")
    turn_kv: int | None = coded("H")
    turn_ki: int | None = coded("H")
    acceleration: int | None = coded("H")
    deceleration: int | None = coded("H")
    speed_kp: int | None = coded("H")
    speed_kv: int | None = coded("H")
    speed_ki: int | None = coded("H")
    front_bumpers: int | None = coded("B")
    rear_bumpers: int | None = coded("B")
    charger: int | None = coded("B")
    sonar_cycle: int | None = coded("B")
    auto_baud: int | None = coded("B")
    has_gyro: int | None = coded("B")
    drift_factor: int | None = coded("h")
    aux2_baud: int | None = coded("B")
    aux3_baud: int | None = coded("B")
    ticks_per_mm: int | None = coded("H")
    shutdown_volts: int | None = coded("H")
    firmware: str | None = coded("z")
    gyro_cw: int | None = coded("H")
    gyro_ccw: int | None = coded("H")
    kinematics_delay: int | None = coded("B")
    lateral_speed_top: int | None = coded("H")
    lateral_acceleration_top: int | None = coded("H")
    lateral_speed_max: int | None = coded("H")
    lateral_acceleration: int | None = coded("H")
    lateral_deceleration: int | None = coded("H")
    charge_threshold: int | None = coded("H")
    power_port: int | None = coded("B")
    gyro_rate_limit: int | None = coded("H")
    high_temperature: int | None = coded("b")
    power_bits: int | None = coded("H")
    battery_type: int | None = coded("B")
    charge_low: int | None = coded("H")
    charge_shutdown: int | None = coded("H")
    bootloader: str | None = coded("z")
    config_flags: int | None = coded("I")
    gyro_firmware: int | None = coded("h")

    def packet(self) -> Packet:
        """Return the packet that carries this configuration."""
        return Packet(Type.CONFIG, self.encode())


def decode_config(packet: Packet) -> Config:
    """Return the configuration in a packet.

    Raises
    ------
    ReportError
        It is another packet, or does not even name the robot.
    """
    config = Config.decode(packet.data) if packet.id == Type.CONFIG else None
    if config is None or config.serial_number is None:
        raise ReportError("not a configuration report")
    return config
