/* The loop of quadruple-tank as one would write it by hand in C: the filter driven by its innovations, two sensors and
 * two pumps with models, each of which decides for itself. Eight, four or two paths side by side in a vector of the
 * compiler; logarithms, sines and cosines are those of glibc for vectors or, with -DPOLYNOMIALS, the shorter polynomials
 * of the engine (program/draws.py). tank.py writes the matrices, and these polynomials, in tank_numbers.h. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "tank_numbers.h" /* N, S, M; A, B, G (N x S), L (M x N), OMEGA, CLOSED, C (S x N), LOCAL and KEPT per sensor */

#if defined(__AVX512F__)
enum { LANES = 8 };
#define OF_VECTORS(name) _ZGVeN8v_##name
#elif defined(__AVX2__)
enum { LANES = 4 };
#define OF_VECTORS(name) _ZGVdN4v_##name
#else
enum { LANES = 2 };
#define OF_VECTORS(name) _ZGVbN2v_##name
#endif

typedef double vector __attribute__((vector_size(8 * LANES)));
typedef uint64_t words __attribute__((vector_size(8 * LANES)));
typedef int64_t choice __attribute__((vector_size(8 * LANES))); /* of comparisons: all bits of a lane, or none */

vector OF_VECTORS(log)(vector);
vector OF_VECTORS(sin)(vector);
vector OF_VECTORS(cos)(vector);

#define INLINE static inline __attribute__((always_inline))

INLINE words turned(words word, int by) {
  return (word << by) | (word >> (64 - by));
}

static uint64_t mixed(uint64_t *counter) {
  uint64_t z = (*counter += UINT64_C(0x9E3779B97F4A7C15));
  z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
  z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
  return z ^ (z >> 31);
}

#ifdef POLYNOMIALS
INLINE vector polynomial(const double *coefficients, int count, vector x) {
  vector value = x * 0.0 + coefficients[count - 1];
  for (int i = count - 2; i >= 0; i--) {
    value = value * x + coefficients[i];
  }
  return value;
}

/* -2 log u = -2 log(1 + r) + 2 log c - 2 e log 2 with u = 2^e m, and 1 + r = c m near 1. */
INLINE vector minus_two_log(vector u) {
  words bits = (words)u;
  vector m = (vector)((bits & UINT64_C(0x000FFFFFFFFFFFFF)) | UINT64_C(0x3FF0000000000000)), c, offset, r;
  vector e = __builtin_convertvector((choice)(bits >> 52) - 1023, vector);
#if defined(__AVX512F__)
  vector inverses, logarithms; /* the eight entries of each table are in one vector */
  memcpy(&inverses, INVERSES, sizeof inverses);
  memcpy(&logarithms, LOGARITHMS, sizeof logarithms);
  c = __builtin_shuffle(inverses, (choice)((bits >> 49) & 7));
  offset = __builtin_shuffle(logarithms, (choice)((bits >> 49) & 7));
#else
  for (int i = 0; i < LANES; i++) {
    c[i] = INVERSES[(bits[i] >> 49) & 7];
    offset[i] = LOGARITHMS[(bits[i] >> 49) & 7];
  }
#endif
  r = m * c - 1.0;
  return polynomial(MINUS_TWO_LOG, 6, r) * r + offset - e * 1.3862943611198906;
}

/* Two normal numbers from a word: 32 bits for the radius, 30 for the angle from an axis, one for it, one for the sign. */
INLINE void two_normals(words word, vector *white) {
  vector radius = minus_two_log((__builtin_convertvector((choice)(word >> 32), vector) + 0.5) * 0x1p-32);
  vector t = __builtin_convertvector((choice)(word & 0x3FFFFFFFu), vector) * 0x1p-30 - 0.5, along, across;
  choice axis = (choice)((word << 33)) < 0;
  for (int i = 0; i < LANES; i++) {
    radius[i] = sqrt(radius[i]);
  }
  radius = (vector)((words)radius ^ ((word << 32) & UINT64_C(0x8000000000000000)));
  along = radius * polynomial(COS, 5, t * t);
  across = radius * t * polynomial(SIN, 5, t * t);
  white[0] = (vector)(((choice)along & axis) | ((choice)across & ~axis));
  white[1] = (vector)(((choice)across & axis) | ((choice)along & ~axis));
}
#else
INLINE void two_normals(words word, vector *white) {
  vector u = (__builtin_convertvector((choice)(word >> 32), vector) + 0.5) * 0x1p-32;
  vector angle = __builtin_convertvector((choice)(word & 0xFFFFFFFFu), vector) * (6.283185307179586 * 0x1p-32);
  vector radius = -2.0 * OF_VECTORS(log)(u);
  for (int i = 0; i < LANES; i++) {
    radius[i] = sqrt(radius[i]);
  }
  white[0] = radius * OF_VECTORS(cos)(angle);
  white[1] = radius * OF_VECTORS(sin)(angle);
}
#endif

/* Two standard normal numbers for each lane, by xoshiro256++ and Box and Muller. */
INLINE void draw(words *state, vector *white) {
  words word = turned(state[0] + state[3], 23) + state[0];
  words shifted = state[1] << 17;
  state[2] ^= state[0];
  state[3] ^= state[1];
  state[1] ^= state[2];
  state[0] ^= state[3];
  state[2] ^= shifted;
  state[3] = turned(state[3], 45);
  two_normals(word, white);
}

/* out = matrix times in; zeros cost nothing, since the compiler knows the matrices. */
INLINE void times(int rows, int columns, const double *matrix, const vector *in, vector *out) {
#pragma GCC unroll 4
  for (int r = 0; r < rows; r++) {
    vector sum = {0};
#pragma GCC unroll 4
    for (int c = 0; c < columns; c++) {
      if (matrix[r * columns + c] != 0.0) {
        sum += matrix[r * columns + c] * in[c];
      }
    }
    out[r] = sum;
  }
}

INLINE vector one_or_other(choice first, vector one, vector other) {
  return (vector)(((choice)one & first) | ((choice)other & ~first));
}

INLINE vector count(choice sent) {
  return one_or_other(sent, (vector){0} + 1.0, (vector){0});
}

/* Sums over all paths and steps: the excess of the cost, and the packets of each link. */
void tank(uint64_t seed, long paths, long ticks, double *sums) {
  for (long block = 0; block < paths / LANES; block++) {
    words state[4];
    uint64_t counter = (seed + 1U) * UINT64_C(0xD1342543DE82EF95) + (uint64_t)block * UINT64_C(0x9E3779B97F4A7C1);
    vector total[1 + S + M] = {{0}}, prior[N] = {{0}}, gap[S][N] = {{{0}}}, local[S][N] = {{{0}}};
    vector heard[S][N] = {{{0}}}, held[M][N] = {{{0}}};
    for (int w = 0; w < 4; w++) {
      for (int i = 0; i < LANES; i++) {
        state[w][i] = mixed(&counter);
      }
    }
    for (long tick = 0; tick < ticks; tick++) {
      vector white[S], news[S], y[S], estimate[N], acts[N], command[M], u[M], off[M];
      draw(state, white);
      times(S, S, &ROOT[0], white, news);
      times(S, N, &C[0], prior, y);
      for (int k = 0; k < N; k++) {
        estimate[k] = prior[k] + G[k][0] * news[0] + G[k][1] * news[1];
        acts[k] = estimate[k];
      }
#pragma GCC unroll 2
      for (int s = 0; s < S; s++) { /* the error of the copy of a sensor's contribution, and its decision */
        vector expected[N], seen, wait[N], kept[N], worth[M], cost;
        choice sent;
        y[s] += news[s];
        times(N, N, &OMEGA[0][0], gap[s], wait);
        times(N, N, &CLOSED[0][0], heard[s], expected);
        times(1, N, &C[s * N], expected, &seen);
        times(N, N, &KEPT[s][0][0], local[s], kept);
        for (int k = 0; k < N; k++) {
          local[s][k] = kept[k] + LOCAL[s][k] * y[s];
          wait[k] += G[k][s] * (y[s] - seen);
        }
        times(M, N, &L[0][0], wait, worth);
        cost = H[0][0] * worth[0] * worth[0] + 2.0 * H[0][1] * worth[0] * worth[1] + H[1][1] * worth[1] * worth[1];
        sent = cost > DELTA[s];
        total[1 + s] += count(sent);
        for (int k = 0; k < N; k++) {
          gap[s][k] = (vector)((choice)wait[k] & ~sent);
          heard[s][k] = one_or_other(sent, local[s][k], expected[k]);
          acts[k] -= gap[s][k];
        }
      }
      times(M, N, &L[0][0], acts, command);
#pragma GCC unroll 2
      for (int a = 0; a < M; a++) { /* the decision for a pump */
        vector expected[N], error;
        choice sent;
        times(N, N, &CLOSED[0][0], held[a], expected);
        times(1, N, L[a], expected, &off[a]);
        error = off[a] - command[a];
        sent = H[a][a] * error * error > DELTA[S + a];
        total[1 + S + a] += count(sent);
        for (int k = 0; k < N; k++) {
          held[a][k] = one_or_other(sent, acts[k], expected[k]);
        }
        u[a] = one_or_other(sent, command[a], off[a]);
      }
      times(M, N, &L[0][0], estimate, off);
      times(N, N, &A[0][0], estimate, prior);
      off[0] = u[0] - off[0];
      off[1] = u[1] - off[1];
      total[0] += H[0][0] * off[0] * off[0] + 2.0 * H[0][1] * off[0] * off[1] + H[1][1] * off[1] * off[1];
      for (int k = 0; k < N; k++) {
        prior[k] += B[k][0] * u[0] + B[k][1] * u[1];
      }
    }
    for (int k = 0; k < 1 + S + M; k++) {
      for (int i = 0; i < LANES; i++) {
        sums[k] += total[k][i];
      }
    }
  }
}
