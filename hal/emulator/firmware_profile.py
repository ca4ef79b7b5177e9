"""Which robot is emulated, and whose habits its firmware has."""

from __future__ import annotations

from dataclasses import dataclass, replace

from visctrl.hal.pioneer.config import UNLIMITED, Config
from visctrl.hal.pioneer.reports import Identity
from visctrl.hal.pioneer.subclasses import Subclass, known_subclasses, subclasses_of
from visctrl.robots import load_robot, robot_names
from visctrl.robots.documents import suggestion
from visctrl.robots.errors import InputError
from visctrl.robots.model import is_path


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


@dataclass(frozen=True)
class FirmwareProfile:
    """A robot to emulate."""

    subclass: Subclass
    personality: Personality
    identity: Identity
    config: Config


def emulated(name: str) -> Subclass:
    """Return a controller to emulate: a subclass, or the first one of a robot, by name or path.

    Raises
    ------
    InputError
        There is no such robot, or it speaks no ARCOS.
    """
    if name.lower() in known_subclasses():
        return known_subclasses()[name.lower()]
    if name not in robot_names() and not is_path(name):
        names = {*known_subclasses(), *robot_names()}
        raise InputError(f"unknown robot '{name}'; {suggestion(name, names)}")
    robot = load_robot(name)
    found = next(iter(subclasses_of(robot).values()), None)
    if found is None:
        raise InputError(f"robot '{robot.name}' speaks no ARCOS: its file has no section 'arcos'")
    return found


def profile(subclass: Subclass, personality: Personality = ARCOS) -> FirmwareProfile:
    """Return a robot to emulate, with the given habits."""
    identity = Identity("Emulated", "Pioneer", subclass.name)
    config = _config(subclass)
    if not personality.full_config:
        config = _without_numbers(config)
    return FirmwareProfile(subclass, personality, identity, config)


def _config(subclass: Subclass) -> Config:
    """Return the parameters of a robot as it was delivered, as far as they are known."""
    flash, skids = subclass.arcos.flash, subclass.robot.drive == "skid-steer"
    sonars = 0 if subclass.sonar is None else len(subclass.sonar.transducers)
    return Config(
        robot_type="Pioneer",
        subclass=subclass.name,
        serial_number="EMU001",
        four_motors=int(skids),
        turn_top=flash.turn_top,
        speed_top=flash.speed_top,
        turn_acceleration_top=flash.turn_acceleration_top,
        acceleration_top=flash.acceleration_top,
        pwm_max=500,
        name="emulated",
        report_cycle=100,
        host_baud=0,
        aux1_baud=0,
        gripper=0,
        front_sonar=int(sonars > 0),
        rear_sonar=int(sonars > 8),
        low_battery=110,
        rev_count=flash.rev_count,
        watchdog=2000,
        p2_packets=0,
        stall_value=200,
        stall_count=300,
        joystick_speed=800,
        joystick_turn=40,
        turn_max=flash.turn_max,
        speed_max=flash.speed_max,
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
        front_bumpers=flash.front_bumpers,
        rear_bumpers=flash.rear_bumpers,
        charger=0,
        sonar_cycle=40,
        auto_baud=0,
        has_gyro=0,
        drift_factor=0,
        aux2_baud=0,
        aux3_baud=0,
        ticks_per_mm=flash.ticks_per_mm,
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
