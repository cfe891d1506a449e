/* ST's StdPeriph library for the STM32F405, the part of it that drives four servos. */
#pragma once
#include <stdint.h>
typedef enum { DISABLE = 0, ENABLE = !DISABLE } FunctionalState;
typedef struct stub_port GPIO_TypeDef; /* registers: in board.c */
typedef struct stub_timer TIM_TypeDef;
#ifdef __arm__
#define GPIOA_BASE 0x40020000u
#define GPIOB_BASE 0x40020400u
#define TIM3_BASE 0x40000400u
#define TIM5_BASE 0x40000C00u
#else
extern GPIO_TypeDef stub_gpio_a, stub_gpio_b;
extern TIM_TypeDef stub_tim3, stub_tim5;
#define GPIOA_BASE &stub_gpio_a
#define GPIOB_BASE &stub_gpio_b
#define TIM3_BASE &stub_tim3
#define TIM5_BASE &stub_tim5
#endif
#define GPIOA ((GPIO_TypeDef *)GPIOA_BASE)
#define GPIOB ((GPIO_TypeDef *)GPIOB_BASE)
#define TIM3 ((TIM_TypeDef *)TIM3_BASE)
#define TIM5 ((TIM_TypeDef *)TIM5_BASE)
/* ARM's own: the processor's counter of cycles */
typedef struct {
  volatile uint32_t CTRL, CYCCNT;
} DWT_Type;
typedef struct {
  volatile uint32_t DHCSR, DCRSR, DCRDR, DEMCR;
} CoreDebug_Type;
#define DWT_CTRL_CYCCNTENA_Msk 1ul
#define CoreDebug_DEMCR_TRCENA_Msk (1ul << 24)
#ifdef __arm__
#define DWT_BASE 0xE0001000ul
#define CoreDebug_BASE 0xE000EDF0ul
#else
DWT_Type *stub_dwt(void); /* each look takes some cycles */
extern CoreDebug_Type stub_core_debug;
#define DWT_BASE stub_dwt()
#define CoreDebug_BASE &stub_core_debug
#endif
#define DWT ((DWT_Type *)DWT_BASE)
#define CoreDebug ((CoreDebug_Type *)CoreDebug_BASE)
typedef enum { GPIO_Mode_AF = 2 } GPIOMode_TypeDef;
typedef enum { GPIO_OType_OD = 1 } GPIOOType_TypeDef;
typedef enum { GPIO_Speed_2MHz = 0 } GPIOSpeed_TypeDef;
typedef enum { GPIO_PuPd_NOPULL = 0 } GPIOPuPd_TypeDef;
typedef struct {
  uint32_t GPIO_Pin;
  GPIOMode_TypeDef GPIO_Mode;
  GPIOSpeed_TypeDef GPIO_Speed;
  GPIOOType_TypeDef GPIO_OType;
  GPIOPuPd_TypeDef GPIO_PuPd;
} GPIO_InitTypeDef;
typedef struct {
  uint16_t TIM_Prescaler, TIM_CounterMode;
  uint32_t TIM_Period;
  uint16_t TIM_ClockDivision;
  uint8_t TIM_RepetitionCounter;
} TIM_TimeBaseInitTypeDef;
typedef struct {
  uint16_t TIM_OCMode, TIM_OutputState, TIM_OutputNState;
  uint32_t TIM_Pulse;
  uint16_t TIM_OCPolarity, TIM_OCNPolarity, TIM_OCIdleState, TIM_OCNIdleState;
} TIM_OCInitTypeDef;
#define GPIO_Pin_2 ((uint16_t)0x0004)
#define GPIO_Pin_3 ((uint16_t)0x0008)
#define GPIO_Pin_4 ((uint16_t)0x0010)
#define GPIO_Pin_5 ((uint16_t)0x0020)
#define GPIO_PinSource2 ((uint8_t)0x02)
#define GPIO_PinSource3 ((uint8_t)0x03)
#define GPIO_PinSource4 ((uint8_t)0x04)
#define GPIO_PinSource5 ((uint8_t)0x05)
#define GPIO_AF_TIM3 ((uint8_t)0x02)
#define GPIO_AF_TIM5 ((uint8_t)0x02)
#define RCC_AHB1Periph_GPIOA ((uint32_t)0x00000001)
#define RCC_AHB1Periph_GPIOB ((uint32_t)0x00000002)
#define RCC_APB1Periph_TIM3 ((uint32_t)0x00000002)
#define RCC_APB1Periph_TIM5 ((uint32_t)0x00000008)
#define TIM_CounterMode_Up ((uint16_t)0x0000)
#define TIM_OCMode_PWM1 ((uint16_t)0x0060)
#define TIM_OutputState_Enable ((uint16_t)0x0001)
#define TIM_OCPolarity_High ((uint16_t)0x0000)
#define TIM_OCPreload_Enable ((uint16_t)0x0008)
void GPIO_StructInit(GPIO_InitTypeDef *);
void GPIO_Init(GPIO_TypeDef *, GPIO_InitTypeDef *);
void GPIO_PinAFConfig(GPIO_TypeDef *, uint16_t, uint8_t);
void RCC_AHB1PeriphClockCmd(uint32_t, FunctionalState);
void RCC_APB1PeriphClockCmd(uint32_t, FunctionalState);
void TIM_TimeBaseStructInit(TIM_TimeBaseInitTypeDef *);
void TIM_TimeBaseInit(TIM_TypeDef *, TIM_TimeBaseInitTypeDef *);
void TIM_ARRPreloadConfig(TIM_TypeDef *, FunctionalState);
void TIM_OCStructInit(TIM_OCInitTypeDef *);
void TIM_OC1Init(TIM_TypeDef *, TIM_OCInitTypeDef *);
void TIM_OC2Init(TIM_TypeDef *, TIM_OCInitTypeDef *);
void TIM_OC3Init(TIM_TypeDef *, TIM_OCInitTypeDef *);
void TIM_OC4Init(TIM_TypeDef *, TIM_OCInitTypeDef *);
void TIM_OC1PreloadConfig(TIM_TypeDef *, uint16_t);
void TIM_OC2PreloadConfig(TIM_TypeDef *, uint16_t);
void TIM_OC3PreloadConfig(TIM_TypeDef *, uint16_t);
void TIM_OC4PreloadConfig(TIM_TypeDef *, uint16_t);
void TIM_SetCompare1(TIM_TypeDef *, uint32_t);
void TIM_SetCompare2(TIM_TypeDef *, uint32_t);
void TIM_SetCompare3(TIM_TypeDef *, uint32_t);
void TIM_SetCompare4(TIM_TypeDef *, uint32_t);
void TIM_Cmd(TIM_TypeDef *, FunctionalState);
