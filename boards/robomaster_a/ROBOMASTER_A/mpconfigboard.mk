MCU_SERIES = f4
CMSIS_MCU = STM32F427xx
# The 439 with 2 MiB of flash has the memory of this 427. Its script keeps the file system, 256 KiB, in the second
# bank; that of the 427 has 112 KiB for it, which the library and the firmware fill.
LD_FILES = boards/stm32f439.ld boards/common_ifs.ld
TEXT0_ADDR = 0x08000000
TEXT1_ADDR = 0x08020000

# The alternate functions of the 427 are those of the 429 (table 12 of their common data sheet).
AF_FILE = boards/stm32f429_af.csv

FROZEN_MANIFEST ?= $(BOARD_DIR)/manifest.py
