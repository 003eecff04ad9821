// RoboMaster development board A, STM32F427IIH6. Pins after the vendor's CubeMX projects (RoboMaster/DevelopmentBoard-
// Examples, *.ioc) and, for CAN, I2C, the power switches and the buzzer, RMdevBoard_ChibiOS (hw/board_rm2018.h).

#define MICROPY_HW_BOARD_NAME       "RoboMaster board A"
#define MICROPY_HW_MCU_NAME         "STM32F427IIH6"

#define MICROPY_HW_ENABLE_RNG       (1)
#define MICROPY_HW_ENABLE_RTC       (1)
#define MICROPY_HW_ENABLE_USB       (1)
#define MICROPY_HW_HAS_FLASH        (1)
#define MICROPY_HW_HAS_SWITCH       (1)

// The file system has two pieces of the second bank, 192 + 64 KiB (stm32f439.ld).
#define MICROPY_HW_ENABLE_INTERNAL_FLASH_STORAGE_SEGMENT2 (1)

// The SD card stays off: its driver and SPI5's receiver both use DMA2 stream 3. A transfer of the card in the main
// program and the MPU6500's in the tick would spoil each other.
#define MICROPY_HW_ENABLE_SDCARD    (0)
// TIM5 belongs to PWM connectors here.
#define MICROPY_HW_ENABLE_SERVO     (0)

// Crystal of 12 MHz (stm32f4xx_hal_conf.h): VCO 12 / 6 * 168 = 336 MHz, core / 2 = 168 MHz, USB / 7 = 48 MHz. At the
// 180 MHz that the chip can run the same VCO cannot give USB its 48 MHz.
#define MICROPY_HW_CLK_PLLM         (6)
#define MICROPY_HW_CLK_PLLN         (168)
#define MICROPY_HW_CLK_PLLP         (RCC_PLLP_DIV2)
#define MICROPY_HW_CLK_PLLQ         (7)

// No 32 kHz crystal
#define MICROPY_HW_RTC_USE_LSE      (0)
#define MICROPY_HW_RTC_USE_US       (0)
#define MICROPY_HW_RTC_USE_CALOUT   (0)

// SPI1: the OLED connector. SPI5: the MPU6500, whose select pin (PF6) is driven as a plain pin.
#define MICROPY_HW_SPI1_NAME        "OLED"
#define MICROPY_HW_SPI1_SCK         (pin_B3)
#define MICROPY_HW_SPI1_MISO        (pin_B4)
#define MICROPY_HW_SPI1_MOSI        (pin_A7)
#define MICROPY_HW_SPI5_NAME        "IMU"
#define MICROPY_HW_SPI5_SCK         (pin_F7)
#define MICROPY_HW_SPI5_MISO        (pin_F8)
#define MICROPY_HW_SPI5_MOSI        (pin_F9)

#define MICROPY_HW_I2C2_NAME        "I2C"
#define MICROPY_HW_I2C2_SCL         (pin_F1)
#define MICROPY_HW_I2C2_SDA         (pin_F0)

// UART1: the remote control's receiver (DBUS, inverted on the board)
#define MICROPY_HW_UART1_NAME       "DBUS"
#define MICROPY_HW_UART1_TX         (pin_B6)
#define MICROPY_HW_UART1_RX         (pin_B7)
#define MICROPY_HW_UART2_TX         (pin_D5)
#define MICROPY_HW_UART2_RX         (pin_D6)
#define MICROPY_HW_UART3_TX         (pin_D8)
#define MICROPY_HW_UART3_RX         (pin_D9)
#define MICROPY_HW_UART6_TX         (pin_G14)
#define MICROPY_HW_UART6_RX         (pin_G9)

#define MICROPY_HW_CAN1_NAME        "CAN1"
#define MICROPY_HW_CAN1_TX          (pin_D1)
#define MICROPY_HW_CAN1_RX          (pin_D0)
#define MICROPY_HW_CAN2_NAME        "CAN2"
#define MICROPY_HW_CAN2_TX          (pin_B13)
#define MICROPY_HW_CAN2_RX          (pin_B12)

// The white button: high when pressed, held low by the board otherwise. PB2 is BOOT1 as well.
#define MICROPY_HW_USRSW_PIN        (pin_B2)
#define MICROPY_HW_USRSW_PULL       (GPIO_NOPULL)
#define MICROPY_HW_USRSW_EXTI_MODE  (GPIO_MODE_IT_RISING)
#define MICROPY_HW_USRSW_PRESSED    (1)

// Both light up when low.
#define MICROPY_HW_LED1             (pin_E11) // red
#define MICROPY_HW_LED2             (pin_F14) // green
#define MICROPY_HW_LED_ON(pin)      (mp_hal_pin_low(pin))
#define MICROPY_HW_LED_OFF(pin)     (mp_hal_pin_high(pin))

// The micro USB connector has no line that tells whether a host is there.
#define MICROPY_HW_USB_FS           (1)
