/* Registers of the STM32F405 (RM0090) and of the Cortex-M4 (ARMv7-M Architecture Reference Manual, B3) by their addresses. */
#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define RCC_CR REGISTER(0x40023800)
#define RCC_PLLCFGR REGISTER(0x40023804)
#define RCC_CFGR REGISTER(0x40023808)
#define RCC_AHB1ENR REGISTER(0x40023830)
#define RCC_APB1ENR REGISTER(0x40023840)
#define RCC_APB2ENR REGISTER(0x40023844)
#define FLASH_ACR REGISTER(0x40023C00)
#define GPIO_MODER(port) REGISTER(0x40020000 + 0x400 * (port))
#define GPIO_AFRL(port) REGISTER(0x40020020 + 0x400 * (port))
#define SYSCFG_EXTICR4 REGISTER(0x40013814)
#define EXTI_IMR REGISTER(0x40013C00)
#define EXTI_RTSR REGISTER(0x40013C08)
#define EXTI_PR REGISTER(0x40013C14)
#define IWDG_KR REGISTER(0x40003000)
#define IWDG_PR REGISTER(0x40003004)
#define IWDG_RLR REGISTER(0x40003008)

#define TIM2 0x40000000
#define TIM3 0x40000400
#define TIM7 0x40001400
#define TIM_CR1(timer) REGISTER((timer) + 0x00)
#define TIM_DIER(timer) REGISTER((timer) + 0x0C)
#define TIM_EGR(timer) REGISTER((timer) + 0x14)
#define TIM_CCMR1(timer) REGISTER((timer) + 0x18)
#define TIM_CCER(timer) REGISTER((timer) + 0x20)
#define TIM_CNT(timer) REGISTER((timer) + 0x24)
#define TIM_PSC(timer) REGISTER((timer) + 0x28)
#define TIM_ARR(timer) REGISTER((timer) + 0x2C)
#define TIM_CCR1(timer) REGISTER((timer) + 0x34)
#define TIM_CCR2(timer) REGISTER((timer) + 0x38)

#define I2C1_CR1 REGISTER(0x40005400)
#define I2C1_CR2 REGISTER(0x40005404)
#define I2C1_DR REGISTER(0x40005410)
#define I2C1_SR1 REGISTER(0x40005414)
#define I2C1_SR2 REGISTER(0x40005418)
#define I2C1_CCR REGISTER(0x4000541C)
#define I2C1_TRISE REGISTER(0x40005420)
#define USART6_SR REGISTER(0x40011400)
#define USART6_DR REGISTER(0x40011404)
#define USART6_BRR REGISTER(0x40011408)
#define USART6_CR1 REGISTER(0x4001140C)
#define USART6_CR3 REGISTER(0x40011414)

#define DMA1 0x40026000
#define DMA2 0x40026400
#define DMA_LIFCR(dma) REGISTER((dma) + 0x08)
#define DMA_HIFCR(dma) REGISTER((dma) + 0x0C)
#define DMA_CR(dma, stream) REGISTER((dma) + 0x10 + 0x18 * (stream))
#define DMA_NDTR(dma, stream) REGISTER((dma) + 0x14 + 0x18 * (stream))
#define DMA_PAR(dma, stream) REGISTER((dma) + 0x18 + 0x18 * (stream))
#define DMA_M0AR(dma, stream) REGISTER((dma) + 0x1C + 0x18 * (stream))

#define SYST_CSR REGISTER(0xE000E010)
#define SYST_RVR REGISTER(0xE000E014)
#define SYST_CVR REGISTER(0xE000E018)
#define NVIC_ISER(n) REGISTER(0xE000E100 + 4 * (n))
#define NVIC_ISPR(n) REGISTER(0xE000E200 + 4 * (n))
#define NVIC_IPR(irq) (*(volatile uint8_t *)(0xE000E400 + (irq)))
#define SCB_ICSR REGISTER(0xE000ED04)
#define SCB_AIRCR REGISTER(0xE000ED0C)
#define SCB_SHPR(exception) (*(volatile uint8_t *)(0xE000ED14 + (exception)))
#define SCB_CPACR REGISTER(0xE000ED88)
#define PENDSVSET (1u << 28)
