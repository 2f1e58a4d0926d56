// The two-mass loop as one would write it by hand for AVX-512: what this processor can do, to measure against.
//
// Eight paths per vector. Matrices and weights are compile-time constants from numbers.h, which limit.py writes from the
// problem, so that zeros and ones cost nothing. Two forms of the same law: `full` with plant and filter (six normals per
// step), `innovations` as the filter sees it (two normals, and the noise factor folded into the gain).
#include <immintrin.h>

#include <cmath>
#include <cstdint>

#include "numbers.h"

#define INLINE static inline __attribute__((always_inline))

using V = __m512d;
using U = __m512i;

INLINE V all(double value) { return _mm512_set1_pd(value); }
INLINE U every(uint64_t word) { return _mm512_set1_epi64(static_cast<long long>(word)); }
INLINE V fma(V a, V b, V c) { return _mm512_fmadd_pd(a, b, c); }
INLINE V fma(double a, V b, V c) { return a == 0 ? c : a == 1 ? b + c : _mm512_fmadd_pd(all(a), b, c); }
INLINE V times(double a, V b) { return a == 1 ? b : all(a) * b; }

// xoshiro256++ (Blackman and Vigna 2021), one stream per lane, seeded by SplitMix64 of seed and path.
struct Generator {
    U a, b, c, d;

    Generator(uint64_t seed, uint64_t path) {
        alignas(64) uint64_t words[4][8];
        for (uint64_t lane = 0; lane < 8; ++lane) {
            uint64_t counter = mix((path + lane) * 0xD1342543DE82EF95u + seed);
            for (auto &word : words) word[lane] = mix(counter += 0x9E3779B97F4A7C15u);
        }
        a = _mm512_load_si512(words[0]), b = _mm512_load_si512(words[1]);
        c = _mm512_load_si512(words[2]), d = _mm512_load_si512(words[3]);
    }

    static uint64_t mix(uint64_t z) {
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        return z ^ (z >> 31);
    }

    INLINE U next(Generator &g) {
        const U word = _mm512_add_epi64(_mm512_rol_epi64(_mm512_add_epi64(g.a, g.d), 23), g.a);
        const U shifted = _mm512_slli_epi64(g.b, 17);
        const U c = _mm512_xor_si512(g.c, g.a), d = _mm512_xor_si512(g.d, g.b);
        g.b = _mm512_xor_si512(g.b, c), g.a = _mm512_xor_si512(g.a, d);
        g.c = _mm512_xor_si512(c, shifted), g.d = _mm512_rol_epi64(d, 45);
        return word;
    }
};

// −2 log u for u in (0, 1): u = 2^e m, m in [1, 2); m times a tabled reciprocal is 1 + r, |r| < 1/17, and a polynomial.
INLINE V minus_two_log(V u) {
    alignas(64) static const double reciprocal[8] = {16. / 17, 16. / 19, 16. / 21, 16. / 23,
                                                     16. / 25, 16. / 27, 16. / 29, 16. / 31};
    alignas(64) static const double logarithm[8] = {
        -2 * std::log(17. / 16), -2 * std::log(19. / 16), -2 * std::log(21. / 16), -2 * std::log(23. / 16),
        -2 * std::log(25. / 16), -2 * std::log(27. / 16), -2 * std::log(29. / 16), -2 * std::log(31. / 16)};
    const V exponent = _mm512_getexp_pd(u);
    const V m = _mm512_getmant_pd(u, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_src);
    const U row = _mm512_srli_epi64(_mm512_castpd_si512(m), 49);
    const V r = fma(m, _mm512_permutexvar_pd(row, _mm512_load_pd(reciprocal)), all(-1));
    const V whole = fma(all(-2 * M_LN2), exponent, _mm512_permutexvar_pd(row, _mm512_load_pd(logarithm)));
    V p = fma(all(1. / 3), r, all(-2. / 5));
    p = fma(p, r, all(1. / 2));
    p = fma(p, r, all(-2. / 3));
    p = fma(p, r, all(1));
    p = fma(p, r, all(-2));
    return fma(p, r, whole);
}

// Two normals by Box and Muller (1958) from one word: 32 bits for the radius, 30 for the angle, a sign and a swap.
INLINE void normals(Generator &g, V &first, V &second) {
    const U word = Generator::next(g);
    const V u = fma(_mm512_cvtepu64_pd(_mm512_srli_epi64(word, 32)), all(0x1p-32), all(0x1p-33));
    const V radius = _mm512_sqrt_pd(_mm512_max_pd(minus_two_log(u), all(0)));
    const U bits = _mm512_and_si512(word, every(0x3FFFFFFFu));
    const V turn = fma(_mm512_cvtepi64_pd(bits), all(0x1p-30), all(0x1p-31 - 0.5));  // of a quarter, in (−½, ½)
    const V square = turn * turn;
    V cosine = all(0.0009036298857944601), sine = all(0.00015820652678813778);
    cosine = fma(cosine, square, all(-0.020860070410128363)), sine = fma(sine, square, all(-0.004681266368307904));
    cosine = fma(cosine, square, all(0.25366920379732133)), sine = fma(sine, square, all(0.07969258274306916));
    cosine = fma(cosine, square, all(-1.2337005406402766)), sine = fma(sine, square, all(-0.6459640961476686));
    cosine = fma(cosine, square, all(0.999999999952545)), sine = fma(sine, square, all(1.570796326788107));
    const U sign = _mm512_and_si512(_mm512_slli_epi64(word, 32), every(1ull << 63));
    const V signed_radius = _mm512_castsi512_pd(_mm512_xor_si512(_mm512_castpd_si512(radius), sign));
    const V along = signed_radius * cosine, across = signed_radius * sine * turn;
    const __mmask8 swap = _mm512_test_epi64_mask(word, every(1ull << 30));
    first = _mm512_mask_blend_pd(swap, along, across), second = _mm512_mask_blend_pd(swap, across, along);
}

struct Totals {
    V cost = all(0), sent = all(0), excess = all(0);
};

// The trigger: send where −θ(x̂'Qx̂ + u'Ru) + (R + (1+θ)B'KB) e² > γ; Q and R are multiples of the identity.
INLINE V decide(const V estimate[4], V held, V &sum_of_squares, Totals &totals) {
    V command = times(L[0], estimate[0]);
    for (int i = 1; i < 4; ++i) command = fma(L[i], estimate[i], command);
    V squares = estimate[0] * estimate[0];
    for (int i = 1; i < 4; ++i) squares = fma(estimate[i], estimate[i], squares);
    const V error = held - command, error_squared = error * error;
    const V trigger = fma(ERROR_WEIGHT, error_squared, times(-THETA * Q, fma(held, held, squares)));
    const __mmask8 send = _mm512_cmp_pd_mask(trigger, all(GAMMA), _CMP_GT_OQ);
    totals.sent = _mm512_mask_add_pd(totals.sent, send, totals.sent, all(1));
    totals.excess = _mm512_mask_add_pd(totals.excess, static_cast<__mmask8>(~send), totals.excess, error_squared);
    sum_of_squares = squares;
    return _mm512_mask_blend_pd(send, held, command);
}

struct Full {
    V x[4] = {all(0), all(0), all(0), all(0)}, prior[4] = {all(0), all(0), all(0), all(0)}, u = all(0);

    INLINE void step(Full &s, Generator &g, Totals &totals) {
        V w[4], v[2], estimate[4], squares;
        normals(g, v[0], v[1]), normals(g, w[0], w[1]), normals(g, w[2], w[3]);
        const V r0 = fma(V_ROOT, v[0], s.x[0]) - s.prior[0], r1 = fma(V_ROOT, v[1], s.x[1]) - s.prior[1];
        for (int i = 0; i < 4; ++i) estimate[i] = fma(KALMAN[i][0], r0, fma(KALMAN[i][1], r1, s.prior[i]));
        s.u = decide(estimate, s.u, squares, totals);
        V stage = s.u * s.u;
        for (int i = 0; i < 4; ++i) stage = fma(s.x[i], s.x[i], stage);
        totals.cost = totals.cost + stage;
        V moved[4];
        for (int i = 0; i < 4; ++i) {
            moved[i] = fma(B[i], s.u, times(W_ROOT, w[i]));
            V prior = times(B[i], s.u);
            for (int j = 0; j < 4; ++j) moved[i] = fma(A[i][j], s.x[j], moved[i]), prior = fma(A[i][j], estimate[j], prior);
            s.prior[i] = prior;
        }
        for (int i = 0; i < 4; ++i) s.x[i] = moved[i];
    }
};

struct Innovations {
    V prior[4] = {all(0), all(0), all(0), all(0)}, u = all(0);

    INLINE void step(Innovations &s, Generator &g, Totals &totals) {
        V xi[2], estimate[4], squares;
        normals(g, xi[0], xi[1]);
        for (int i = 0; i < 4; ++i) estimate[i] = fma(DRIVEN[i][0], xi[0], fma(DRIVEN[i][1], xi[1], s.prior[i]));
        s.u = decide(estimate, s.u, squares, totals);
        totals.cost = totals.cost + fma(s.u, s.u, squares);
        for (int i = 0; i < 4; ++i) {
            V prior = times(B[i], s.u);
            for (int j = 0; j < 4; ++j) prior = fma(A[i][j], estimate[j], prior);
            s.prior[i] = prior;
        }
    }
};

template <class Form, int BLOCKS>
void run(uint64_t seed, long paths, long ticks, double *found) {
    Totals whole;
    for (long path = 0; path < paths; path += 8 * BLOCKS) {
        Form forms[BLOCKS];
        Totals totals[BLOCKS];
        Generator first(seed, static_cast<uint64_t>(path)), second(seed, static_cast<uint64_t>(path + 8));
        for (long k = 0; k < ticks; ++k) {
            Form::step(forms[0], first, totals[0]);
            if (BLOCKS == 2) Form::step(forms[BLOCKS - 1], second, totals[BLOCKS - 1]);  // more to do at once
        }
        for (const Totals &one : totals) {
            whole.cost = whole.cost + one.cost, whole.sent = whole.sent + one.sent;
            whole.excess = whole.excess + one.excess;
        }
    }
    found[0] = Q * _mm512_reduce_add_pd(whole.cost), found[1] = _mm512_reduce_add_pd(whole.sent);
    found[2] = EXCESS_WEIGHT * _mm512_reduce_add_pd(whole.excess);
}

extern "C" {
void full(uint64_t seed, long paths, long ticks, double *found) { run<Full, 1>(seed, paths, ticks, found); }
void innovations(uint64_t seed, long paths, long ticks, double *found) { run<Innovations, 1>(seed, paths, ticks, found); }
void innovations_paired(uint64_t seed, long paths, long ticks, double *found) {
    run<Innovations, 2>(seed, paths, ticks, found);
}
void peak(uint64_t, long paths, long ticks, double *found) {  // twelve fused multiply-adds that wait for nothing
    V a = all(0), b = a, c = a, d = a, e = a, f = a, g = a, h = a, i = a, j = a, k = a, l = a;
    const V x = all(1e-9);
    for (long n = 0; n < paths / 8 * ticks; ++n)
        asm volatile(
            "vfmadd231pd %12, %12, %0\n vfmadd231pd %12, %12, %1\n vfmadd231pd %12, %12, %2\n"
            "vfmadd231pd %12, %12, %3\n vfmadd231pd %12, %12, %4\n vfmadd231pd %12, %12, %5\n"
            "vfmadd231pd %12, %12, %6\n vfmadd231pd %12, %12, %7\n vfmadd231pd %12, %12, %8\n"
            "vfmadd231pd %12, %12, %9\n vfmadd231pd %12, %12, %10\n vfmadd231pd %12, %12, %11"
            : "+v"(a), "+v"(b), "+v"(c), "+v"(d), "+v"(e), "+v"(f), "+v"(g), "+v"(h), "+v"(i), "+v"(j), "+v"(k), "+v"(l)
            : "v"(x));
    found[0] = _mm512_reduce_add_pd(a + b + c + d + e + f + g + h + i + j + k + l);
}
void draws(uint64_t seed, long paths, long ticks, double *found) {
    V sum = all(0), squares = all(0);
    for (long path = 0; path < paths; path += 8) {
        Generator g(seed, static_cast<uint64_t>(path));
        for (long k = 0; k < ticks; ++k) {
            V first, second;
            normals(g, first, second);
            sum = sum + first + second, squares = fma(first, first, fma(second, second, squares));
        }
    }
    found[0] = _mm512_reduce_add_pd(sum), found[1] = _mm512_reduce_add_pd(squares);
}
}
