/* ST's StdPeriph library for the STM32F405, the part of it that drives four servos. */
#pragma once
#include <stdint.h>
typedef enum { DISABLE = 0, ENABLE = !DISABLE } FunctionalState;
typedef struct {
  volatile uint32_t MODER, OTYPER, OSPEEDR, PUPDR, IDR, ODR, BSRR, LCKR, AFR[2];
} GPIO_TypeDef;
typedef struct {
  volatile uint32_t CR1, CR2, SMCR, DIER, SR, EGR, CCMR1, CCMR2, CCER, CNT, PSC, ARR, RCR, CCR1, CCR2, CCR3, CCR4;
} TIM_TypeDef;
#ifdef __arm__
#define GPIOA ((GPIO_TypeDef *)0x40020000)
#define GPIOB ((GPIO_TypeDef *)0x40020400)
#define TIM3 ((TIM_TypeDef *)0x40000400)
#define TIM5 ((TIM_TypeDef *)0x40000C00)
#else
extern GPIO_TypeDef stub_gpio[2];
extern TIM_TypeDef stub_timer[2];
#define GPIOA (&stub_gpio[0])
#define GPIOB (&stub_gpio[1])
#define TIM3 (&stub_timer[0])
#define TIM5 (&stub_timer[1])
#endif
typedef enum { GPIO_Mode_IN = 0, GPIO_Mode_OUT = 1, GPIO_Mode_AF = 2, GPIO_Mode_AN = 3 } GPIOMode_TypeDef;
typedef enum { GPIO_OType_PP = 0, GPIO_OType_OD = 1 } GPIOOType_TypeDef;
typedef enum { GPIO_Low_Speed = 0, GPIO_High_Speed = 3 } GPIOSpeed_TypeDef;
typedef enum { GPIO_PuPd_NOPULL = 0, GPIO_PuPd_UP = 1 } GPIOPuPd_TypeDef;
#define GPIO_Speed_2MHz GPIO_Low_Speed
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
void GPIO_StructInit(GPIO_InitTypeDef *init);
void GPIO_Init(GPIO_TypeDef *port, GPIO_InitTypeDef *init);
void GPIO_PinAFConfig(GPIO_TypeDef *port, uint16_t source, uint8_t function);
void RCC_AHB1PeriphClockCmd(uint32_t peripheral, FunctionalState state);
void RCC_APB1PeriphClockCmd(uint32_t peripheral, FunctionalState state);
void TIM_TimeBaseStructInit(TIM_TimeBaseInitTypeDef *init);
void TIM_TimeBaseInit(TIM_TypeDef *timer, TIM_TimeBaseInitTypeDef *init);
void TIM_ARRPreloadConfig(TIM_TypeDef *timer, FunctionalState state);
void TIM_OCStructInit(TIM_OCInitTypeDef *init);
void TIM_OC1Init(TIM_TypeDef *timer, TIM_OCInitTypeDef *init);
void TIM_OC2Init(TIM_TypeDef *timer, TIM_OCInitTypeDef *init);
void TIM_OC3Init(TIM_TypeDef *timer, TIM_OCInitTypeDef *init);
void TIM_OC4Init(TIM_TypeDef *timer, TIM_OCInitTypeDef *init);
void TIM_OC1PreloadConfig(TIM_TypeDef *timer, uint16_t preload);
void TIM_OC2PreloadConfig(TIM_TypeDef *timer, uint16_t preload);
void TIM_OC3PreloadConfig(TIM_TypeDef *timer, uint16_t preload);
void TIM_OC4PreloadConfig(TIM_TypeDef *timer, uint16_t preload);
void TIM_SetCompare1(TIM_TypeDef *timer, uint32_t compare);
void TIM_SetCompare2(TIM_TypeDef *timer, uint32_t compare);
void TIM_SetCompare3(TIM_TypeDef *timer, uint32_t compare);
void TIM_SetCompare4(TIM_TypeDef *timer, uint32_t compare);
void TIM_Cmd(TIM_TypeDef *timer, FunctionalState state);
