#ifndef ROBOMASTER_A_STM32F4XX_HAL_CONF_H
#define ROBOMASTER_A_STM32F4XX_HAL_CONF_H

// Hz: the crystal; the I2S clock input, which is not connected
#define HSE_VALUE (12000000)
#define EXTERNAL_CLOCK_VALUE (12288000)

// ms to wait for the oscillators; there is no 32 kHz crystal
#define HSE_STARTUP_TIMEOUT (100)
#define LSE_STARTUP_TIMEOUT (0)

#include "boards/stm32f4xx_hal_conf_base.h"

#endif
