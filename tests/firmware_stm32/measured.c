/* Ten functions with all kinds of branches, some of which never run: what coverage reports of them on the chip is compared
 * with what gcov reports on the host. */
static volatile int total;

#define FUNCTION __attribute__((noinline)) static

FUNCTION int magnitude(int x) {
  if (x < 0) {
    x = -x;
  }
  return x;
}

FUNCTION int clamp(int x, int low, int high) {
  if (x < low)
    return low;
  if (x > high)
    return high;
  return x;
}

FUNCTION int sum_of_odd(int n) {
  int sum = 0;
  for (int i = 0; i < n; i++) {
    if (i % 2 == 0)
      continue;
    sum += i;
  }
  return sum;
}

FUNCTION int digits(unsigned x) {
  int count = 0;
  do {
    count++;
    x /= 10u;
  } while (x);
  return count;
}

FUNCTION int find(const int *values, int n, int wanted) {
  int at = 0;
  while (at < n && values[at] != wanted) {
    at++;
  }
  if (at == n) {
    return -1;
  }
  return at;
}

FUNCTION int weekday(int number) {
  switch (number) {
    case 1:
      return 10;
    case 2:
      return 20;
    case 40:
      return 30;
    default:
      break;
  }
  return 0;
}

FUNCTION int factorial(int n) {
  if (n < 2) {
    return 1;
  }
  return n * factorial(n - 1);
}

FUNCTION int allowed(int armed, int flying, int level) {
  if ((armed && flying) || level > 3) {
    return 1;
  }
  return 0;
}

FUNCTION int sort(int *values, int n) {
  int swaps = 0;
  for (int i = 1; i < n; i++) {
    for (int j = i; j > 0 && values[j - 1] > values[j]; j--) {
      int kept = values[j];
      values[j] = values[j - 1];
      values[j - 1] = kept;
      swaps++;
    }
  }
  return swaps;
}

FUNCTION int never(int x) {
  while (x) {
    x--;
  }
  return x;
}

void measured(void) {
  int values[6] = {5, 3, 9, 1, 7, 2};
  total += magnitude(-4);
  total += clamp(3, 0, 10) + clamp(30, 0, 10);
  total += sum_of_odd(7) + digits(12345u);
  total += find(values, 6, 1) + find(values, 6, 9);
  total += weekday(2) + weekday(6) + factorial(5);
  total += allowed(1, 0, 2) + allowed(1, 1, 0);
  total += sort(values, 6);
  if (total < 0) {
    total += never(3);
  }
}
