"""Programs of requests, each a law of the services: what a client sees must be the same on every board.

A program begins with its name after `==`; `stock` behind it: the law is the firmware's own and holds without Floaty's app.
`hil.deploy.services` has the words. The robot begins at home, at rest, with absolute poses; nothing is commanded yet.
"""

from collections.abc import Mapping

TEXT = """
== a command without the notice has no effect and the board locks
takeoff 1.1 1.0
wait 1.3
look
stream position 0 0 1.1 0 1.0
goto 0.08 0 1.1 0 1.0
wait 0.3
look
wait 1.0
look
wait 1.2
look
takeoff 1.1 1
goto 0 0 1.1 0 1
stop
== with the notice the command is flown
takeoff 1.1 1
wait 1.2
stream position 0.05 0 1.1 0 1
notify
wait 0.1
look
goto 0.08 0 1.1 0 1
wait 0.5
look
wait 3
look
== a landing after a stream needs the notice
takeoff 1.1 1
wait 1.2
stream position 0 0.05 1.1 0 0.6
land 0.9 1
wait 0.7
look
wait 1.6
look
== a landing after a stream and the notice
takeoff 1.1 1
wait 1.2
stream position 0 0.05 1.1 0 0.6
notify
land 0.9 1
wait 0.5
look
wait 1.5
look
takeoff 1.1 1
wait 1.2
look
== a take-off after a stream is accepted but not flown
stream position 0 0 1.2 0 0.5
takeoff 1.0 1
takeoff 1.0 1
wait 0.4
look
wait 2
look
== a trajectory after a stream is accepted but not flown
upload straight 0
define 1 0 0 1
takeoff 1.15 1
wait 1.2
stream position 0 0.04 1.1 0 0.5
start 1
wait 0.4
look
wait 2
look
== a stop after a stream does not end the silence
takeoff 1.1 1
wait 1.2
stream position 0 0 1.1 0 0.5
stop
wait 0.3
look
wait 2
look
== a stream that begins again in time flies on
takeoff 1.1 1
wait 1.2
stream position 0 0 1.1 0 0.5
wait 1.2
look
stream position 0.04 0 1.1 0 0.5
look
wait 1.2
stream position 0.04 0.04 1.1 0 0.5
notify
wait 3
look
== the notice may come late
stream position 0.03 0 1.15 0 0.5
wait 1.5
look
notify
wait 0.2
look
wait 3
look
goto 0 0 1.15 0 1
wait 1.2
look
== one hover set-point in a flight locks the board
takeoff 1.1 1
wait 1.2
setpoint hover 0 0 0 1.1
wait 0.3
look
wait 1
look
wait 1
look
== one velocity set-point in a flight locks the board
takeoff 1.1 1
wait 1.2
setpoint velocity 0.1 0 0 0
wait 1
look
goto 0.05 0 1.1 0 1
wait 1.2
look
== one manual set-point in a flight locks the board
takeoff 1.1 1
wait 1.2
setpoint manual
wait 0.6
look
wait 1.6
look
== a zero attitude unlocks no thrust and locks the board
setpoint attitude 0
takeoff 1.1 1
wait 0.4
look
wait 2
look
== a program that ends in the air
takeoff 1.1 1
wait 1.5
disconnect
wait 0.2
look
wait 0.5
look
wait 1.8
look
== a program that lands before it ends locks the board, too
takeoff 1.1 1
wait 1.2
land 0.9 1
wait 1.2
disconnect
wait 1
look
wait 1.5
look
== a program that ends its set-points with the notice and the link with zeros
takeoff 1.1 1
wait 1.2
stream position 0 0 1.1 0 0.5
notify
disconnect
notify
wait 3
look
== a stop set-point is a set-point
takeoff 1.1 1
wait 1.2
setpoint stop
wait 0.3
look
takeoff 1.2 1
wait 2
look
== a set-point of an unknown type is a null set-point
takeoff 1.1 1
wait 1.2
ask 7 0 c800
wait 0.3
look
wait 2
look
== full states are followed
stream full 0.05 0 1.15 1.0
look
stream full 0.05 0.05 1.2 0.6
notify
wait 1
look
== a position outside the box is not followed but keeps the board alive
stream position 0.3 0 1.15 0 3
look
stream position 0.1 0 1.15 0 0.5
look
notify
wait 0.3
look
== numbers that are not finite in a set-point are not followed
stream position nan 0 1.15 0 0.5
look
stream position 0.05 0 1.15 nan 0.5
look
notify
wait 0.3
look
== set-points turn the robot
stream position 0 0 1.15 60 0.6
look
stream position 0.05 0 1.15 -60 0.6
notify
goto 0.05 0 1.15 0 1
wait 1.2
look
== take-off, three goals and a landing
takeoff 1.0 1
wait 1.2
goto 0.1 0 1.1 0 1
wait 1.2
goto 0 0.1 1.1 90 1.5
wait 1.7
goto 0 0 1.2 0 1
wait 1.2
look
land 0.6 2
wait 2.2
look
== a second take-off and a second landing are refused
takeoff 1.1 1
takeoff 1.2 1
wait 1.2
takeoff 1.2 1
land 0.9 1
land 0.8 1
wait 0.5
land 0.8 1
wait 1
land 0.8 0.5
wait 0.7
look
== a path interrupts another
takeoff 1.1 1
wait 0.5
goto 0.1 0 1.1 0 1
wait 0.5
goto 0 0 1.2 0 1
wait 0.4
land 0.9 1
wait 0.5
goto 0 0 1.1 0 1
wait 1.3
look
== relative goals
takeoff 1.1 0.8
wait 1
goto 0.05 0.05 0.05 30 1 relative
wait 0.5
goto 0.05 0 0 0 1 relative
wait 1.2
goto 0 -0.1 0 -60 1 relative
wait 1.2
look
== linear goals
takeoff 1.1 0.8
wait 1
goto 0.1 0 1.1 0 1 linear
wait 1.2
goto 0 0.05 1.1 45 1 linear
wait 1.2
goto 0 0 0.1 0 1 linear relative
wait 1.2
look
== goals without time are jumps
takeoff 1.1 0
wait 0.2
look
goto 0.05 0 1.1 0 0
wait 0.2
look
goto 0 0 1.1 0 -1
wait 0.2
look
land 0.95 0
wait 0.2
look
== yaw is turned the shorter way round
takeoff 1.1 1 150
wait 1.2
goto 0 0 1.1 -150 1
wait 1.2
look
land 0.9 1 0
wait 1.2
look
== take-off and landing by velocity
rise 1.3 0.3
wait 1
look
sink 0.2 0.2 relative
wait 1.4
look
rise 0.1 0 relative
wait 0.6
look
sink 0.9 0
wait 1
look
== the groups of a command
set hlCommander.groupmask U8 6
ask 8 0 0702cdcc8c3f00000000010000803f
wait 0.3
look
ask 8 0 0701cdcc8c3f00000000010000803f
wait 1.2
ask 8 0 0c0100000000000000000000803f000000000000803f
wait 1.2
look
ask 8 0 0c0400000000000000000000803f000000000000803f
wait 1.2
look
ask 8 0 0002 2
read hlCommander.groupmask
== older commands fly the same paths
ask 8 0 01009a99993f0000003f
wait 0.7
look
ask 8 0 040001cdcc4c3d0000000000000000000000000000003f
wait 0.7
look
ask 8 0 02000000803f0000003f
wait 0.7
look
== a spiral to the left
takeoff 1.1 0.8
wait 1
spiral 90 0.05 0.05 0 1.5
wait 1.7
look
spiral -90 0.05 0.1 0.05 1.5
wait 1.7
look
== a spiral clockwise and sideways
takeoff 1.1 0.8
wait 1
spiral 90 0.05 0.02 0 1.5 clockwise
wait 1.7
look
spiral 180 0.03 0.05 -0.05 2 sideways
wait 2.2
look
spiral 800 0.03 0.03 0 2 sideways clockwise
wait 2.2
look
== numbers that are not finite are refused and the flight goes on
takeoff 1.1 0.8
wait 1
goto nan 0 1.1 0 1
wait 1
look
goto 0 0 inf 0 1
takeoff nan 1
land 0.9 nan
spiral nan 0.1 0.1 0 1
goto 0.05 0 1.1 0 1
wait 2.5
look
== paths without the time for them are refused
takeoff 1.1 0.8
wait 1
goto 0.05 0 1.1 0 0 linear
goto 0.05 0 1.1 0 -1 linear
spiral 90 0.05 0.05 0 0
wait 2.5
look
goto 0.05 0 1.1 0 1
wait 1.2
look
== commands of a wrong size are refused
ask 8 0 0700cdcc8c3f
ask 8 0 0c00
ask 8 0 0c0000000000000000000000000000803f00000000
wait 2.5
look
ask 8 0 63000000
ask 8 0 0e000000
takeoff 1.1 1
wait 1.2
look
== goals outside the box are refused
takeoff 1.1 1
wait 1.2
goto 0.16 0 1.1 0 1
goto 0.11 0.11 1.1 0 1
goto 0 0 1.7 0 1
land 0 2
land 0.49 2
sink 1 0.5 relative
rise 3 0.5
goto 0.2 0 0 0 1 relative
spiral 180 0.15 0.15 0 2
wait 0.5
look
goto 0.14 0 1.1 0 1
wait 1.2
look
== the box follows its parameters
set box.radius F32 0.05
takeoff 1.1 1
goto 0.06 0 1.1 0 1
set box.radius F32 0.1
goto 0.06 0 1.1 0 1
wait 1.2
look
stream position 0.11 0 1.1 0 0.5
look
notify
wait 0.2
look
== a trajectory of polynomials
upload corner 0
define 1 0 0 2
takeoff 1.15 0.8
wait 1
start 1
wait 0.5
look
wait 1.7
look
start 1 2.0
wait 4.2
look
start 1 0.5
wait 1.2
look
== a reversed trajectory
upload corner 0
define 1 0 0 2
takeoff 1.15 0.8
wait 1
start 1 reversed
wait 2.2
look
start 1 1.5 reversed
wait 3.2
look
== a relative trajectory
upload turning 0
define 2 0 0 1
takeoff 1.15 0.8
wait 1
goto -0.05 0.05 1.1 0 1
wait 1.2
start 2 relative
wait 2.2
look
start 2 relative reversed
wait 2.2
look
== a turned trajectory turns about its origin
upload turning 0
define 2 0 0 1
takeoff 1.15 0.8
wait 1
goto 0 0 1.1 90 1
wait 1.2
start 2 relative turned
wait 2.2
look
goto 0 0 1.1 -45 1
wait 1.2
start 2 relative turned reversed
wait 2.2
look
start 2 turned
wait 2.2
look
== spirals that end outside the box are refused
takeoff 1.1 1
wait 1.2
goto 0 0.1 1.1 0 0.8
wait 1
spiral 180 0.05 0.05 0 1
wait 0.4
goto 0 0.1 1.1 0 0.8
wait 1
spiral 180 0.05 0.05 0 1 clockwise
wait 0.4
goto 0 -0.1 1.1 0 0.8
wait 1
spiral 180 0.05 0.05 0 1
wait 0.4
goto 0 -0.1 1.1 0 0.8
wait 1
spiral 180 0.05 0.05 0 1 clockwise
wait 0.4
goto 0.1 0 1.1 0 0.8
wait 1
spiral 180 0.05 0.05 0 1 sideways
wait 0.4
goto 0.1 0 1.1 0 0.8
wait 1
spiral 180 0.05 0.05 0 1 sideways clockwise
wait 0.4
goto -0.1 0 1.1 0 0.8
wait 1
spiral 180 0.05 0.05 0 1 sideways
wait 0.4
goto -0.1 0 1.1 0 0.8
wait 1
spiral 180 0.05 0.05 0 1 sideways clockwise
wait 0.4
wait 1
look
== relative climbs and descents are judged by their ends
takeoff 1.3 1
wait 1.2
sink 0.9 0.8 relative
sink 0.75 0.8 relative
wait 1.2
look
rise 1.3 0.8 relative
rise 1.1 0.8 relative
wait 1.6
look
== a trajectory is followed as far as the box goes
takeoff 1.1 1
wait 1.2
upload swing 0
define 1 0 0 1
start 1
wait 0.5
look
wait 0.5
values 0.2 stateEstimate.x~0.01
wait 1.5
look
values 0.2 stateEstimate.x~0.01
goto 0 0 1.1 0 1
wait 1.2
look
== there are 31 definitions
upload straight 0
takeoff 1.15 0.8
wait 1
define 0 0 0 1
start 0
wait 2.2
define 10 0 0 1
start 10
wait 0.3
define 30 0 0 1
start 30
wait 2.2
look
define 31 0 0 1
define 255 0 0 1
look
== a trajectory that is not defined is not flown
takeoff 1.15 0.8
wait 1
start 5
start 30
start 31
start 200
wait 0.5
look
ask 8 0 060702000000000001
define 6 2 0 1
start 6
wait 0.5
look
== a compressed trajectory
upload curved 200
define 3 1 200 2
takeoff 1.15 0.8
wait 1
start 3
wait 0.7
look
wait 1.2
look
== a compressed trajectory is neither scaled nor reversed
upload small 0
define 3 1 0 1
takeoff 1.15 0.8
wait 1
start 3 2.0
start 3 0.5
start 3 reversed
start 3 0.5 relative
wait 0.5
look
start 3
wait 2.3
look
== a compressed trajectory may be moved but not turned
upload small 0
define 3 1 0 1
takeoff 1.15 0.8
wait 1
goto -0.05 0.03 1.1 90 1
wait 1.2
start 3 relative
wait 2.3
look
goto -0.05 0.03 1.1 90 1
wait 1.2
start 3 relative turned
wait 2.3
look
== the trajectory memory keeps what it is given
upload corner 0
upload small 300
define 1 0 0 2
define 2 1 300 1
takeoff 1.15 0.8
wait 1
start 2
wait 2.2
start 1
wait 2.2
look
== disarming in flight stops the robot until it is armed
takeoff 1.1 1
wait 1.2
disarm
wait 0.3
look
takeoff 1.1 1
wait 2
look
disarm
arm
wait 0.3
look
goto 0.05 0 1.1 0 1
wait 1.2
look
== disarming by the older port
takeoff 1.1 1
wait 1.2
ask 13 0 0100
wait 0.3
look
ask 13 0 0101
wait 0.3
look
== disarming in a stream of set-points
stream position 0.05 0 1.15 0 0.5
disarm
wait 0.3
look
stream position 0.05 0 1.15 0 0.5
look
arm
wait 0.3
look
stream position 0.05 0 1.15 0 0.5
look
== disarming by the parameter
takeoff 1.1 1
wait 1.2
set floaty.armed U8 0
wait 0.4
look
arm
wait 0.3
look
set floaty.armed U8 0
wait 0.4
set floaty.armed U8 1
wait 0.4
look
disarm
wait 0.4
set floaty.armed U8 1
wait 0.4
look
== disarming between a landing and the next take-off
takeoff 1.1 0.8
wait 1
land 0.8 1
wait 1.2
disarm
wait 0.5
look
arm
wait 0.5
takeoff 1.1 1
wait 1.2
look
== an armed board may be armed again
arm
arm
look
takeoff 1.1 1
arm
wait 1.2
look
== the emergency stop lasts
takeoff 1.1 1
wait 1.2
emergency
wait 0.3
look
arm
recover
takeoff 1.1 1
disarm
stop
wait 0.3
look
== the emergency stop of the localisation port
takeoff 1.1 1
wait 1.2
ask 6 1 0300
wait 0.3
look
ask 6 1 03
wait 0.3
look
== the watchdog of the emergency stop begins with its first meal
takeoff 1.1 1
wait 1.5
look
feed
wait 0.5
feed
wait 0.8
look
ask 6 1 04
wait 0.8
look
wait 0.5
look
== the stop by parameter
takeoff 1.1 1
wait 1.2
set stabilizer.stop U8 1
wait 0.3
look
set stabilizer.stop U8 0
arm
wait 0.3
look
== floaty's own stop can be undone
takeoff 1.1 1
wait 1.2
set floaty.stop U8 1
wait 0.3
look
recover
wait 0.3
look
set floaty.stop U8 0
wait 0.3
look
== a request to recover is answered
recover
ask 13 0 02
disarm
recover
wait 0.3
look
== poses that stop and come back
takeoff 1.1 1
wait 1.2
poses off
wait 1
look
goto 0.05 0 1.1 0 1
wait 0.4
poses on
wait 1.2
look
== poses that stay away end the flight for the commander
takeoff 1.1 1
wait 1.2
poses off
wait 2.2
look
wait 1
look
wait 3.5
look
poses on
wait 0.5
look
takeoff 1.2 1
wait 1.2
look
== poses over the app channel fly the robot
poses app
wait 0.5
takeoff 1.1 1
wait 1.2
goto 0.1 -0.08 1.1 30 1
wait 1.5
values 0.3 stateEstimate.x~0.005 stateEstimate.y~0.005 stateEstimate.z~0.005 stateEstimate.yaw~0.5
look
== packed poses fly the robot whose address they have
poses packed
wait 0.5
takeoff 1.1 1
wait 1.2
goto -0.08 0.1 1.1 -30 1
wait 1.5
values 0.3 stateEstimate.x~0.005 stateEstimate.y~0.005 stateEstimate.z~0.005 stateEstimate.yaw~0.5
look
== the values of a robot that stands askew
disarm
place 0.03 -0.02 1.12 10 -6 25
wait 1.5
values 0.2 stateEstimate.x~0.002 stateEstimate.y~0.002 stateEstimate.z~0.002
values 0.2 stateEstimate.roll~0.1 stateEstimate.pitch~0.1 stateEstimate.yaw~0.1
values 0.2 stateEstimate.vx~0.01 stateEstimate.vy~0.01 stateEstimate.vz~0.01
values 0.2 stateEstimate.qw~0.002 stateEstimate.qx~0.002 stateEstimate.qy~0.002 stateEstimate.qz~0.002
values 0.2 stabilizer.roll~0.1 stabilizer.pitch~0.1 stabilizer.yaw~0.1 stabilizer.thrust~0
values 0.2 pm.vbat~0.02 pm.vbatMV~20 pm.batteryLevel~0 pm.state~0
values 0.2 supervisor.state~0 supervisor.cause~0 floaty.armed~0 floaty.stopped~0 floaty.calibrated~0
values 0.2 stateEstimate.flap_1~0.002 stateEstimate.flap_2~0.002 stateEstimate.flap_3~0.002 stateEstimate.flap_4~0.002
servos 20
== the values of a flight with poses of a known age
poses aged
takeoff 1.1 1
wait 1.2
goto 0.1 0 1.1 0 0.6
values 0.5 controller.u1~0.01 controller.u2~0.01 stateEstimate.vx~0.04 stateEstimate.vy~0.04 stateEstimate.vz~0.04
goto 0 0.09 1.1 0 0.6
values 0.5 controller.u1~0.01 controller.u2~0.01 stateEstimate.vx~0.04 stateEstimate.vy~0.04 stateEstimate.vz~0.04
goto 0 0.09 1.18 0 0.6
values 0.5 controller.u1~0.01 controller.u2~0.01 stateEstimate.vx~0.04 stateEstimate.vy~0.04 stateEstimate.vz~0.04
goto 0.1 -0.08 1.1 40 0.6
wait 0.2
values 0.2 controller.u1~0.03 controller.u2~0.03 controller.u3~0.03 controller.u4~0.03
wait 2
values 0.2 controller.u1~0.01 controller.u2~0.01 controller.u3~0.01 controller.u4~0.01
values 0.2 floaty.m1~100 floaty.m2~100 floaty.m3~100 floaty.m4~100
values 0.2 locSrv.age~10 delayComp.horizon~1 sys.canfly~0 sys.isFlying~0 sys.isTumbled~0 radio.isConnected~0
poses 20.73
wait 0.5
values 1.05 locSrv.age~2 delayComp.horizon~0.15 kalman.jumps~0
== flaps by hand need a client
set extCtrl.m1 F32 0.3
set extCtrl.m2 F32 -0.2
set extCtrl.m3 F32 0.1
set extCtrl.m4 F32 -0.3
set extCtrl.manual U8 1
wait 0.2
servos 20
radio off
wait 2
servos 20
radio on
wait 0.2
servos 20
set extCtrl.manual U8 2
wait 0.2
servos 20
== an empty battery ends the flight
takeoff 1.1 1
wait 1.2
battery 3000
wait 5.6
look
values 0.2 pm.batteryLevel~0 pm.vbatMV~20
battery 3900
wait 0.4
look
set floaty.stop U8 0
wait 0.2
look
== a battery just above the limit flies on, one just below does not
takeoff 1.1 1
wait 1.2
battery 3230
wait 5.6
look
battery 3170
wait 5.6
look
== poses that are cut short are not used
takeoff 1.1 1
wait 1.2
poses cut
wait 0.7
look
poses pose
wait 0.4
look
== a set-point's heading turns the robot
takeoff 1.1 1
wait 1.2
stream position 0.12 -0.06 1.15 50 0.8
notify
goto 0 0 1.1 -50 1
wait 1.2
look
== with corrections nothing is followed
set extPose.absolute U8 0
place 0 0 0
wait 3
look
takeoff 0.1 1
wait 1.2
look
stream position 0 0 0.1 0 3
look
wait 3
look
== bits can be asked one by one
takeoff 1.1 1
wait 0.5
ask 9 0 01
ask 9 0 02
ask 9 0 03
ask 9 0 04
ask 9 0 05
ask 9 0 06
ask 9 0 07
ask 9 0 08
ask 9 0 09
ask 9 0 0a
ask 9 0 0b
ask 9 0 0c
ask 9 0 00
ask 9 0 0d
wait 1
look
== commands before any flight stock
stop
define 31 0 0 1
define 1 0 0 1
ask 8 0 63000000
ask 8 0 0300 2
ask 8 0 0000 2
== the supervisor at rest stock
look
arm
recover
ask 9 0 03
ask 9 0 06
ask 9 0 07
ask 9 0 0d
== identity and link stock
ask 13 1 00
ask 15 1 00
ask 15 0 68656c6c6f
ask 15 0 00010203040506070809
ask 15 2 0102
ask 13 0 0305 0
ask 13 3 00
== parameters by number stock
ask 2 1 60ea
ask 2 2 60ea01
ask 2 3 0460ea 3
read hlCommander.vtoff
write hlCommander.vtoff 0000003f
read hlCommander.vtoff
write hlCommander.groupmask 05
read hlCommander.groupmask
write hlCommander.groupmask 0000
read hlCommander.groupmask
write system.selftestPassed 00
read system.selftestPassed
== parameters by name stock
set hlCommander.vland F32 0.25
read hlCommander.vland
set hlCommander.vland U8 1
set hlCommander.nothing F32 1
set system.selftestPassed I8 0
read hlCommander.vland
== kept parameters stock
misc 4 ring.effect
misc 3 hlCommander.groupmask
misc 4 hlCommander.groupmask
misc 5 hlCommander.groupmask
misc 7 hlCommander.groupmask
misc 2 hlCommander.groupmask
misc 8 hlCommander.groupmask
misc 6 hlCommander.groupmask
== log blocks stock
log 6 33 7 60000
log 6 33 7 stateEstimate.x
log 7 33 7 stateEstimate.x
log 3 34
log 4 34
log 2 34
log 7 34 7 stateEstimate.x
log 2 33
log 2 33
log 11 0
log 6 35
log 2 35
== a full log block stock
log 6 33 7 stateEstimate.x 7 stateEstimate.y 7 stateEstimate.z
log 7 33 7 stateEstimate.vx 7 stateEstimate.vy 7 stateEstimate.vz 2 stateEstimate.x
log 7 33 1 stateEstimate.x
log 6 33 7 stateEstimate.x
log 2 33
log 6 33 7 stateEstimate.x 7 stateEstimate.y 7 stateEstimate.z
log 7 33 7 stateEstimate.vx 7 stateEstimate.vy 7 stateEstimate.vz 2 stateEstimate.x 2 stateEstimate.y
log 7 33 1 stateEstimate.x
log 2 33
log 5 0
== sixteen log blocks stock
log 6 1 7 60000
log 6 2
log 6 3
log 6 4
log 6 5
log 6 6
log 6 7
log 6 8
log 6 9
log 6 10
log 6 11
log 6 12
log 6 13
log 6 14
log 6 15
log 6 16
log 6 17
log 2 1
log 6 17
log 5 0
== memories stock
ask 4 0 01
ask 4 0 0200
ask 4 0 0201
ask 4 0 0202
ask 4 0 0203
ask 4 0 0204
ask 4 1 020000000018
ask 4 1 02f00f000010
ask 4 2 0200000000000102
ask 4 1 00f01f000018 6
== the trajectory memory ends stock
ask 4 1 01ff0f000001
ask 4 1 01ff0f000002
ask 4 1 010010000001
ask 4 2 01ff0f000007
ask 4 2 01ff0f00000708
ask 4 1 01ff0f000001
"""


def _programs() -> Mapping[str, str]:
    found = {}
    for part in TEXT.split("\n== ")[1:]:
        name, _, lines = part.partition("\n")
        found[name.removesuffix(" stock")] = lines
    return found


PROGRAMS = _programs()
STOCK = frozenset(
    line[3:].removesuffix(" stock")
    for line in TEXT.splitlines()
    if line.startswith("== ") and line.endswith(" stock")
)
