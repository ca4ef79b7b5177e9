"""Which robot is emulated, and whose habits its firmware has."""

from __future__ import annotations

from dataclasses import dataclass, replace

from visctrl.hal.pioneer.config import UNLIMITED, Config
from visctrl.hal.pioneer.reports import Identity
from visctrl.hal.pioneer.subclasses import SUBCLASSES, Subclass


@dataclass(frozen=True)
class Personality:
    """Habits in which real firmware and the vendor's simulator differ.

    motors_at_open : motors are enabled as soon as a session opens.
    says_moving : reports of a moving robot have their own type.
    heading_step : heading units between two headings that can be reported.
    watchdog : the robot stops when nothing arrives.
    sonar_per_report : readings in a report.
    forgets_readings : a report just after SONAR announces readings that it does not hold.
    full_config : the firmware knows its own parameters.
    """

    name: str
    motors_at_open: bool
    says_moving: bool
    heading_step: int
    watchdog: bool
    sonar_per_report: int
    forgets_readings: bool
    full_config: bool


ARCOS = Personality("arcos", False, True, 1, True, 8, False, True)
#: The vendor's simulator keeps headings in whole degrees and drives on without its client.
SIMULATOR = Personality("simulator", True, False, 11, False, 16, True, False)
PERSONALITIES = {personality.name: personality for personality in (ARCOS, SIMULATOR)}

#: Robots that can be emulated, by subclass.
EMULATED = ("p3dx-sh", "p3at-sh", "p3dx", "p3at")


@dataclass(frozen=True)
class FirmwareProfile:
    """A robot to emulate."""

    subclass: Subclass
    personality: Personality
    identity: Identity
    config: Config


def character(subclass: str, personality: Personality = ARCOS) -> FirmwareProfile:
    """Return one of the robots in `EMULATED` with the given habits."""
    factors = SUBCLASSES[subclass]
    identity = Identity("Emulated", "Pioneer", subclass)
    config = _config(factors)
    if not personality.full_config:
        config = _without_numbers(config)
    return FirmwareProfile(factors, personality, identity, config)


def _config(factors: Subclass) -> Config:
    """Return the parameters of a robot as it was delivered, as far as they are known."""
    is_dx = factors.robot == "p3dx"
    return Config(
        robot_type="Pioneer",
        subclass=factors.name,
        serial_number="EMU001",
        four_motors=0 if is_dx else 1,
        turn_top=500 if is_dx else 300,
        speed_top=2200 if is_dx else 1200,
        turn_acceleration_top=600,
        acceleration_top=4000,
        pwm_max=500,
        name="emulated",
        report_cycle=100,
        host_baud=0,
        aux1_baud=0,
        gripper=0,
        front_sonar=1,
        rear_sonar=1,
        low_battery=110,
        rev_count=16570 if is_dx else 32550,
        watchdog=2000,
        p2_packets=0,
        stall_value=200,
        stall_count=300,
        joystick_speed=800,
        joystick_turn=40,
        turn_max=300 if is_dx else 150,
        speed_max=1200 if is_dx else 700,
        turn_acceleration=100,
        turn_deceleration=100,
        turn_kp=40,
        turn_kv=20,
        turn_ki=0,
        acceleration=300,
        deceleration=300,
        speed_kp=40,
        speed_kv=30,
        speed_ki=0,
        front_bumpers=5,
        rear_bumpers=5,
        charger=0,
        sonar_cycle=40,
        auto_baud=0,
        has_gyro=0,
        drift_factor=0,
        aux2_baud=0,
        aux3_baud=0,
        ticks_per_mm=132 if is_dx else 138,
        shutdown_volts=105,
        firmware="2.9",
        gyro_cw=0,
        gyro_ccw=0,
        kinematics_delay=0,
    )


def _without_numbers(config: Config) -> Config:
    """Return the parameters as the vendor's simulator reports them: no limits, no encoders."""
    return replace(
        config,
        serial_number="SIM",
        firmware="S.0",
        turn_top=UNLIMITED,
        speed_top=UNLIMITED,
        turn_acceleration_top=UNLIMITED,
        acceleration_top=UNLIMITED,
        low_battery=0,
        rev_count=0,
        ticks_per_mm=0,
        front_bumpers=0,
        rear_bumpers=0,
    )
