// The two-mass loop as one would write it by hand for this processor's vectors: what it can do, to measure against.
//
// One path per lane: eight with AVX-512, four with AVX2, two else. Matrices and weights are compile-time constants from
// numbers.h, which limit.py writes from the problem, so that zeros and ones cost nothing. Two forms of the same law:
// `full` with plant and filter (six normals per step), `innovations` as the filter sees it (two normals, and the noise
// factor folded into the gain). Vectors are those of the compiler; what it has no words for stands in `Unit`.
#include <cmath>
#include <cstdint>
#include <initializer_list>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#include "numbers.h"

#define INLINE static inline __attribute__((always_inline))

#if defined(__AVX512DQ__)
constexpr int LANES = 8;
#elif defined(__AVX2__)
constexpr int LANES = 4;
#else
constexpr int LANES = 2;
#endif

using V = double __attribute__((vector_size(8 * LANES)));
using U = uint64_t __attribute__((vector_size(8 * LANES)));
using Choice = int64_t __attribute__((vector_size(8 * LANES)));  // of comparisons: all bits of a lane, or none

INLINE V all(double value) { return value - V{}; }
INLINE U every(uint64_t word) { return word - U{}; }
INLINE V fma(V a, V b, V c) { return a * b + c; }
INLINE V fma(double a, V b, V c) { return a == 0 ? c : a == 1 ? b + c : all(a) * b + c; }
INLINE V times(double a, V b) { return a == 1 ? b : all(a) * b; }
INLINE V number(U bits) { return reinterpret_cast<V>(bits); }
INLINE U bits_of(V value) { return reinterpret_cast<U>(value); }
INLINE U rotated(U word, int by) { return word << by | word >> (64 - by); }
INLINE double total(V value) {
    double sum = 0;
    for (int lane = 0; lane < LANES; ++lane) sum += value[lane];
    return sum;
}

alignas(64) static const double RECIPROCAL[8] = {16. / 17, 16. / 19, 16. / 21, 16. / 23,
                                                 16. / 25, 16. / 27, 16. / 29, 16. / 31};
alignas(64) static const double LOGARITHM[8] = {
    -2 * std::log(17. / 16), -2 * std::log(19. / 16), -2 * std::log(21. / 16), -2 * std::log(23. / 16),
    -2 * std::log(25. / 16), -2 * std::log(27. / 16), -2 * std::log(29. / 16), -2 * std::log(31. / 16)};

constexpr uint64_t ONE = 0x3FF0000000000000u, MANTISSA = 0x000FFFFFFFFFFFFFu, TWO_52 = 0x4330000000000000u;

// What vector units do in ways of their own: roots, whole numbers below 2^52 as a scale times them and an offset, the
// parts of a number u > 0 (u = 2^e m, m in [1, 2)), and the entries of both tables at the eighth in which m lies.
struct Unit {
#if defined(__AVX512DQ__)
    INLINE V root(V x) { return _mm512_sqrt_pd(x); }
    INLINE V scaled(U whole, double scale, double offset) {
        return fma(_mm512_cvtepu64_pd(reinterpret_cast<__m512i>(whole)), all(scale), all(offset));
    }
    INLINE void split(V u, V &exponent, V &mantissa, V &reciprocal, V &logarithm) {
        exponent = _mm512_getexp_pd(u);
        mantissa = _mm512_getmant_pd(u, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_src);
        const __m512i row = _mm512_srli_epi64(_mm512_castpd_si512(mantissa), 49);
        reciprocal = _mm512_permutexvar_pd(row, _mm512_load_pd(RECIPROCAL));
        logarithm = _mm512_permutexvar_pd(row, _mm512_load_pd(LOGARITHM));
    }
#else
    INLINE V scaled(U whole, double scale, double offset) {
        return fma(number(whole | every(TWO_52)), all(scale), all(offset - 0x1p52 * scale));
    }
    INLINE void parts(V u, V &exponent, V &mantissa) {
        const U bits = bits_of(u);
        exponent = number(bits >> 52 | every(TWO_52)) - all(0x1p52 + 1023);
        mantissa = number((bits & every(MANTISSA)) | every(ONE));
    }
#if defined(__AVX2__)
    INLINE V root(V x) { return _mm256_sqrt_pd(x); }
    INLINE void split(V u, V &exponent, V &mantissa, V &reciprocal, V &logarithm) {
        parts(u, exponent, mantissa);
        // two halves of a table fill two registers; pairs of half words are permuted, and the third bit chooses
        const __m256i row = _mm256_srli_epi64(_mm256_castpd_si256(u), 48);
        const __m256i twice = _mm256_and_si256(row, _mm256_set1_epi64x(14));
        const __m256i pairs = _mm256_or_si256(_mm256_shuffle_epi32(twice, 0xA0), _mm256_set1_epi64x(1ll << 32));
        const __m256d upper = _mm256_castsi256_pd(_mm256_slli_epi64(row, 60));
        reciprocal = pick(RECIPROCAL, pairs, upper), logarithm = pick(LOGARITHM, pairs, upper);
    }
    INLINE V pick(const double *table, __m256i pairs, __m256d upper) {
        const __m256 low = _mm256_load_ps(reinterpret_cast<const float *>(table));
        const __m256 high = _mm256_load_ps(reinterpret_cast<const float *>(table + 4));
        return _mm256_blendv_pd(_mm256_castps_pd(_mm256_permutevar8x32_ps(low, pairs)),
                                _mm256_castps_pd(_mm256_permutevar8x32_ps(high, pairs)), upper);
    }
#else
    INLINE V root(V x) {
        for (int lane = 0; lane < LANES; ++lane) x[lane] = __builtin_sqrt(x[lane]);
        return x;
    }
    INLINE void split(V u, V &exponent, V &mantissa, V &reciprocal, V &logarithm) {
        parts(u, exponent, mantissa);
        const U row = bits_of(u) >> 49 & every(7);
        for (int lane = 0; lane < LANES; ++lane)
            reciprocal[lane] = RECIPROCAL[row[lane]], logarithm[lane] = LOGARITHM[row[lane]];
    }
#endif
#endif
};

// xoshiro256++ (Blackman and Vigna 2021), one stream per lane, seeded by SplitMix64 of seed and path.
struct Generator {
    U a{}, b{}, c{}, d{};

    Generator(uint64_t seed, uint64_t path) {
        for (int lane = 0; lane < LANES; ++lane) {
            uint64_t counter = mix((path + static_cast<uint64_t>(lane)) * 0xD1342543DE82EF95u + seed);
            for (U *word : {&a, &b, &c, &d}) (*word)[lane] = mix(counter += 0x9E3779B97F4A7C15u);
        }
    }

    static uint64_t mix(uint64_t z) {
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        return z ^ (z >> 31);
    }

    INLINE U next(Generator &g) {
        const U word = rotated(g.a + g.d, 23) + g.a, shifted = g.b << 17;
        const U c = g.c ^ g.a, d = g.d ^ g.b;
        g.b ^= c, g.a ^= d, g.c = c ^ shifted, g.d = rotated(d, 45);
        return word;
    }
};

// −2 log u for u in (0, 1): m times a tabled reciprocal is 1 + r, |r| < 1/17, and a polynomial.
INLINE V minus_two_log(V u) {
    V exponent, m, reciprocal, logarithm;
    Unit::split(u, exponent, m, reciprocal, logarithm);
    const V r = fma(m, reciprocal, all(-1)), whole = fma(all(-2 * M_LN2), exponent, logarithm);
    V p = fma(all(0.3346349590338773), r, all(-0.4014874488621837));
    p = fma(p, r, all(0.4999983095557708));
    p = fma(p, r, all(-0.6666647349251146));
    p = fma(p, r, all(1.0000000003250018));
    p = fma(p, r, all(-2.0000000003714016));
    return fma(p, r, whole);
}

// Two normals by Box and Muller (1958) from one word: 32 bits for the radius, 30 for the angle, a sign and a swap.
INLINE void normals(Generator &g, V &first, V &second) {
    const U word = Generator::next(g);
    const V u = Unit::scaled(word >> 32, 0x1p-32, 0x1p-33);  // such that −2 log u > 0
    const V radius = Unit::root(minus_two_log(u));
    const V turn = Unit::scaled(word & every(0x3FFFFFFFu), 0x1p-30, -0.5);  // of a quarter, in [−½, ½)
    const V square = turn * turn;
    V cosine = all(0.0009036298857944601), sine = all(0.00015820652678813778);
    cosine = fma(cosine, square, all(-0.020860070410128363)), sine = fma(sine, square, all(-0.004681266368307904));
    cosine = fma(cosine, square, all(0.25366920379732133)), sine = fma(sine, square, all(0.07969258274306916));
    cosine = fma(cosine, square, all(-1.2337005406402766)), sine = fma(sine, square, all(-0.6459640961476686));
    cosine = fma(cosine, square, all(0.999999999952545)), sine = fma(sine, square, all(1.570796326788107));
    const V signed_radius = number(bits_of(radius) ^ (word << 32 & every(1ull << 63)));
    const V along = signed_radius * cosine, across = signed_radius * sine * turn;
    const Choice swap = reinterpret_cast<Choice>(word << 33) < 0;
    first = swap ? across : along, second = swap ? along : across;
}

struct Totals {
    V cost = {}, sent = {}, excess = {};
};

// The trigger: send where −θ(x̂'Qx̂ + u'Ru) + (R + (1+θ)B'KB) e² > γ; Q and R are multiples of the identity.
INLINE V decide(const V estimate[4], V held, V &sum_of_squares, Totals &totals) {
    V command = times(L[0], estimate[0]);
    for (int i = 1; i < 4; ++i) command = fma(L[i], estimate[i], command);
    V squares = estimate[0] * estimate[0];
    for (int i = 1; i < 4; ++i) squares = fma(estimate[i], estimate[i], squares);
    const V error = held - command, error_squared = error * error;
    const V trigger = fma(ERROR_WEIGHT, error_squared, times(-THETA * Q, fma(held, held, squares)));
    const Choice send = trigger > all(GAMMA);
    totals.sent = totals.sent + (send ? all(1) : all(0));
    totals.excess = totals.excess + (send ? all(0) : error_squared);
    sum_of_squares = squares;
    return send ? command : held;
}

struct Full {
    V x[4] = {}, prior[4] = {}, u = {}, v[2], w[4];

    Full(Generator &g) { draw(*this, g); }
    INLINE void draw(Full &s, Generator &g) {
        normals(g, s.v[0], s.v[1]), normals(g, s.w[0], s.w[1]), normals(g, s.w[2], s.w[3]);
    }

    INLINE void step(Full &s, Generator &g, Totals &totals) {
        const Full at = s;
        draw(s, g);
        V estimate[4], squares;
        const V r0 = fma(V_ROOT, at.v[0], s.x[0]) - s.prior[0], r1 = fma(V_ROOT, at.v[1], s.x[1]) - s.prior[1];
        for (int i = 0; i < 4; ++i) estimate[i] = fma(KALMAN[i][0], r0, fma(KALMAN[i][1], r1, s.prior[i]));
        s.u = decide(estimate, s.u, squares, totals);
        V stage = s.u * s.u;
        for (int i = 0; i < 4; ++i) stage = fma(s.x[i], s.x[i], stage);
        totals.cost = totals.cost + stage;
        V moved[4];
        for (int i = 0; i < 4; ++i) {
            moved[i] = fma(B[i], s.u, times(W_ROOT, at.w[i]));
            V prior = times(B[i], s.u);
            for (int j = 0; j < 4; ++j) moved[i] = fma(A[i][j], s.x[j], moved[i]), prior = fma(A[i][j], estimate[j], prior);
            s.prior[i] = prior;
        }
        for (int i = 0; i < 4; ++i) s.x[i] = moved[i];
    }
};

// The full form over a link that delays packets by 0, 1 or 2 steps or loses them: a ring of three packets. The sender
// assumes that its packet acts at once.
struct Late : Full {
    V applied = {}, left[2] = {all(NEVER), all(NEVER)}, packet[2] = {};

    static constexpr double NEVER = 1e6;
    Late(Generator &g) : Full(g) {}

    INLINE void step(Late &s, Generator &g, Totals &totals) {
        const Full at = s;
        draw(s, g);
        V estimate[4], squares;
        const V r0 = fma(V_ROOT, at.v[0], s.x[0]) - s.prior[0], r1 = fma(V_ROOT, at.v[1], s.x[1]) - s.prior[1];
        for (int i = 0; i < 4; ++i) estimate[i] = fma(KALMAN[i][0], r0, fma(KALMAN[i][1], r1, s.prior[i]));
        const V before = totals.sent, u = decide(estimate, s.u, squares, totals);
        const V uniform = Unit::scaled(Generator::next(g) >> 12, 0x1p-52, 0x1p-53);
        V wait = uniform < all(DELAYS[0]) ? all(0) : uniform < all(DELAYS[1]) ? all(1) : uniform < all(DELAYS[2]) ? all(2) : all(NEVER);
        wait = totals.sent > before ? wait : all(NEVER);
        const Choice newest = wait < all(0.5), middle = s.left[0] < all(0.5), oldest = s.left[1] < all(0.5);
        s.applied = newest ? u : middle ? s.packet[0] : oldest ? s.packet[1] : s.applied;
        s.left[1] = (newest | middle) ? all(NEVER) : s.left[0] - all(1);
        s.left[0] = newest ? all(NEVER) : wait - all(1);
        s.packet[1] = s.packet[0], s.packet[0] = u, s.u = u;
        V stage = s.applied * s.applied;
        for (int i = 0; i < 4; ++i) stage = fma(s.x[i], s.x[i], stage);
        totals.cost = totals.cost + stage;
        V moved[4];
        for (int i = 0; i < 4; ++i) {
            moved[i] = fma(B[i], s.applied, times(W_ROOT, at.w[i]));
            V prior = times(B[i], s.u);
            for (int j = 0; j < 4; ++j) moved[i] = fma(A[i][j], s.x[j], moved[i]), prior = fma(A[i][j], estimate[j], prior);
            s.prior[i] = prior;
        }
        for (int i = 0; i < 4; ++i) s.x[i] = moved[i];
    }
};

struct Innovations {
    V prior[4] = {}, u = {}, xi[2];

    Innovations(Generator &g) { normals(g, xi[0], xi[1]); }
    INLINE void step(Innovations &s, Generator &g, Totals &totals) {
        V xi[2] = {s.xi[0], s.xi[1]}, estimate[4], squares;
        normals(g, s.xi[0], s.xi[1]);
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
    for (long path = 0; path < paths; path += LANES * BLOCKS) {
        Totals totals[BLOCKS];
        Generator first(seed, static_cast<uint64_t>(path)), second(seed, static_cast<uint64_t>(path + LANES));
        Form one(first), other(second);  // each has its draws for the step to come: they wait for nothing
        for (long k = 0; k < ticks; ++k) {
            Form::step(one, first, totals[0]);
            if (BLOCKS == 2) Form::step(other, second, totals[BLOCKS - 1]);  // more to do at once
        }
        for (const Totals &one : totals) {
            whole.cost = whole.cost + one.cost, whole.sent = whole.sent + one.sent;
            whole.excess = whole.excess + one.excess;
        }
    }
    found[0] = Q * total(whole.cost), found[1] = total(whole.sent);
    found[2] = EXCESS_WEIGHT * total(whole.excess);
}

extern "C" {
void full(uint64_t seed, long paths, long ticks, double *found) { run<Full, 1>(seed, paths, ticks, found); }
void late(uint64_t seed, long paths, long ticks, double *found) { run<Late, 1>(seed, paths, ticks, found); }
void innovations(uint64_t seed, long paths, long ticks, double *found) { run<Innovations, 1>(seed, paths, ticks, found); }
void innovations_paired(uint64_t seed, long paths, long ticks, double *found) {
    run<Innovations, 2>(seed, paths, ticks, found);
}
void peak(uint64_t, long paths, long ticks, double *found) {  // ten fused multiply-adds that wait for nothing
    V many[10] = {};
    V x = all(1e-9);
    asm volatile("" : "+m"(x));  // not known to the compiler
    for (long n = 0; n < paths / LANES * ticks; ++n)
        for (V &one : many) one = fma(x, x, one);
    found[0] = 0;
    for (const V &one : many) found[0] += total(one);
}
void draws(uint64_t seed, long paths, long ticks, double *found) {
    V sum = all(0), squares = all(0);
    for (long path = 0; path < paths; path += LANES) {
        Generator g(seed, static_cast<uint64_t>(path));
        for (long k = 0; k < ticks; ++k) {
            V first, second;
            normals(g, first, second);
            sum = sum + first + second, squares = fma(first, first, fma(second, second, squares));
        }
    }
    found[0] = total(sum), found[1] = total(squares);
}
}
