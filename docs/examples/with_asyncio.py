# The attitude beside other tasks: `await imu.next()` gives the reading of the next step. While the interpreter collects
# garbage (33 ms on a Pico) the tick goes on, but this program does not: reading.step tells how many steps went by.

import asyncio

import upright


async def attitude(imu):
    n = 0
    while True:
        reading = await imu.next()
        n += 1
        if n % 50 == 0:
            print("reading", n, "of step", reading.step, "angles", *reading.angles())


async def everything_else():
    n = 0
    while True:
        await asyncio.sleep_ms(250)
        n += 1
        print("other task", n)


async def main():
    with upright.start() as imu:
        await asyncio.gather(attitude(imu), everything_else())


asyncio.run(main())
