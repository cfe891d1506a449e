/* The servo outputs: see floaty_app.h.
 *
 * The pins are the original's (BigQuad map): M1 PA2, M2 PB4, M3 PB5, M4 PA3. PA2 and PA3 use TIM5 (channels 3 and 4)
 * instead of TIM2, whose time base and channel 4 belong to the firmware's own motor driver: both timers run at 84 MHz,
 * the signal is the same. PB4 and PB5 are channels 1 and 2 of TIM3. Of the firmware, only the drivers of some decks use these
 * two timers: buzzer, rpm and lighthouse tester TIM5, LED ring, rpm and CPPM receiver TIM3.
 */
#include "floaty_app.h"

#include "stm32fxxx.h"

#define PRESCALER 4    /* 84 MHz to 21 MHz */
#define PERIOD 52500   /* reload value: 2.500048 ms */

static void init_pin(GPIO_TypeDef *port, uint16_t pin, uint8_t source, uint8_t function) {
  GPIO_InitTypeDef gpio;
  GPIO_StructInit(&gpio);
  gpio.GPIO_Pin = pin;
  gpio.GPIO_Mode = GPIO_Mode_AF;
  gpio.GPIO_Speed = GPIO_Speed_2MHz;
  gpio.GPIO_OType = GPIO_OType_OD; /* pulled up to the servos' supply outside */
  gpio.GPIO_PuPd = GPIO_PuPd_NOPULL;
  GPIO_PinAFConfig(port, source, function);
  GPIO_Init(port, &gpio);
}

static void init_time_base(TIM_TypeDef *timer) {
  TIM_TimeBaseInitTypeDef base;
  TIM_TimeBaseStructInit(&base);
  base.TIM_Prescaler = PRESCALER - 1;
  base.TIM_CounterMode = TIM_CounterMode_Up;
  base.TIM_Period = PERIOD;
  TIM_TimeBaseInit(timer, &base);
  TIM_ARRPreloadConfig(timer, ENABLE);
}

void floaty_servos_init(const int32_t count[4]) {
  TIM_OCInitTypeDef output;

  RCC_AHB1PeriphClockCmd(RCC_AHB1Periph_GPIOA | RCC_AHB1Periph_GPIOB, ENABLE);
  RCC_APB1PeriphClockCmd(RCC_APB1Periph_TIM3 | RCC_APB1Periph_TIM5, ENABLE);
  init_time_base(TIM3);
  init_time_base(TIM5);

  TIM_OCStructInit(&output);
  output.TIM_OCMode = TIM_OCMode_PWM1;
  output.TIM_OutputState = TIM_OutputState_Enable;
  output.TIM_OCPolarity = TIM_OCPolarity_High;
  TIM_OC3Init(TIM5, &output);
  TIM_OC1Init(TIM3, &output);
  TIM_OC2Init(TIM3, &output);
  TIM_OC4Init(TIM5, &output);
  floaty_servos_write(count);
  TIM_OC3PreloadConfig(TIM5, TIM_OCPreload_Enable);
  TIM_OC1PreloadConfig(TIM3, TIM_OCPreload_Enable);
  TIM_OC2PreloadConfig(TIM3, TIM_OCPreload_Enable);
  TIM_OC4PreloadConfig(TIM5, TIM_OCPreload_Enable);
  TIM_Cmd(TIM3, ENABLE);
  TIM_Cmd(TIM5, ENABLE);

  init_pin(GPIOA, GPIO_Pin_2, GPIO_PinSource2, GPIO_AF_TIM5);
  init_pin(GPIOB, GPIO_Pin_4, GPIO_PinSource4, GPIO_AF_TIM3);
  init_pin(GPIOB, GPIO_Pin_5, GPIO_PinSource5, GPIO_AF_TIM3);
  init_pin(GPIOA, GPIO_Pin_3, GPIO_PinSource3, GPIO_AF_TIM5);
}

void floaty_servos_write(const int32_t count[4]) {
  TIM_SetCompare3(TIM5, (uint32_t)count[0]);
  TIM_SetCompare1(TIM3, (uint32_t)count[1]);
  TIM_SetCompare2(TIM3, (uint32_t)count[2]);
  TIM_SetCompare4(TIM5, (uint32_t)count[3]);
}
