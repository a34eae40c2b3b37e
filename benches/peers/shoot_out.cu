// The work of benches/shoot_out.rs by a kernel written by hand: one thread a trajectory, everything
// in registers, Tsitouras' 5(4) pairs with the step control that is usual for them. A peer that
// knows the system when it is compiled; what a general program reaches of it is what counts.
//
//   nvcc -O3 -arch=native -o shoot_out shoot_out.cu && ./shoot_out 1048576 [van_der_pol]
//
// One JSON line a setting, with the fields of shoot_out.rs. Errors are taken against the same method
// in f64 at 1e-14.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

#define CHECK(call) do { cudaError_t e_ = (call); if (e_ != cudaSuccess) { \
    fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, cudaGetErrorString(e_)); exit(1); } } while (0)

struct Pendulum {
    static constexpr int DIM = 5;
    static constexpr double TIME = 4.0, SHIFT = -1.5;
    // (s, p, V) backward in time; s is the deviation from the equilibrium at theta = -1.5.
    template <class R> __device__ static void rate(const R* y, R* d, R steady) {
        const R q = 5.55, r = 1.85, g = 9.81;
        R sine, cosine;
        sincos_(y[0] - R(1.5), &sine, &cosine);
        R w = -y[3] / r;
        d[0] = -y[1];
        d[1] = g * sine - steady - w;
        d[2] = q * y[0] - g * cosine * y[3];
        d[3] = q * y[1] + y[2];
        d[4] = R(0.5) * (q * y[0] * y[0] + q * y[1] * y[1] + r * w * w);
    }
    __device__ static void sincos_(float x, float* s, float* c) { sincosf(x, s, c); }
    __device__ static void sincos_(double x, double* s, double* c) { sincos(x, s, c); }
    static double steady() { return 9.81 * std::sin(-1.5); }
    static void seeds(size_t n, std::vector<double>& out) {
        const double q = 5.55, r = 1.85, a = -9.81 * std::cos(-1.5), c = 1e-4;
        const double p12 = r * (a + std::sqrt(a * a + q / r)), p22 = std::sqrt(r * (2 * p12 + q));
        const double p11 = p22 * (p12 / r - a);
        const double mean = (p11 + p22) / 2, half = std::hypot((p11 - p22) / 2, p12);
        const double turn = 0.5 * std::atan2(2 * p12, p11 - p22);
        for (size_t k = 0; k < n; k++) {
            const double angle = 2 * M_PI * double(k) / double(n);
            const double z0 = std::cos(angle) / std::sqrt(mean + half) * std::sqrt(2 * c);
            const double z1 = std::sin(angle) / std::sqrt(mean - half) * std::sqrt(2 * c);
            const double s0 = std::cos(turn) * z0 - std::sin(turn) * z1;
            const double s1 = std::sin(turn) * z0 + std::cos(turn) * z1;
            const double y[5] = {s0, s1, p11 * s0 + p12 * s1, p12 * s0 + p22 * s1, c};
            for (int j = 0; j < 5; j++) out[j * n + k] = y[j];
        }
    }
};

struct VanDerPol {
    static constexpr int DIM = 2;
    static constexpr double TIME = 20.0, SHIFT = 0.0;
    template <class R> __device__ static void rate(const R* y, R* d, R) {
        d[0] = y[1];
        d[1] = (R(1) - y[0] * y[0]) * y[1] - y[0];
    }
    static double steady() { return 0; }
    static void seeds(size_t n, std::vector<double>& out) {
        const double by[2] = {0.7548776662466928, 0.5698402909980533};
        for (size_t k = 0; k < n; k++)
            for (int j = 0; j < 2; j++) {
                const double at = 0.5 + double(k) * by[j];
                out[j * n + k] = 4 * (at - std::floor(at)) - 2;
            }
    }
};

template <class R, class S> __global__ void __launch_bounds__(128)
integrate(const R* in, R* out, unsigned* steps, size_t n, R rtol, R time, R steady) {
    constexpr int D = S::DIM;
    const size_t i = size_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i >= n) return;
    R y[D], k1[D], k2[D], k3[D], k4[D], k5[D], k6[D], k7[D], z[D];
    for (int j = 0; j < D; j++) y[j] = in[j * n + i];
    S::rate(y, k1, steady);
    R t = 0, h = R(0.01);
    unsigned taken = 0;
    float before = 1e-4f;
    while (t < time && taken < 1000000u) {
        if (h > time - t) h = time - t;
        #pragma unroll
        for (int j = 0; j < D; j++) z[j] = y[j] + h * R(0.161) * k1[j];
        S::rate(z, k2, steady);
        #pragma unroll
        for (int j = 0; j < D; j++) z[j] = y[j] + h * (R(-0.008480655492356989) * k1[j] + R(0.335480655492357) * k2[j]);
        S::rate(z, k3, steady);
        #pragma unroll
        for (int j = 0; j < D; j++) z[j] = y[j] + h * (R(2.8971530571054935) * k1[j] + R(-6.359448489975075) * k2[j] + R(4.3622954328695815) * k3[j]);
        S::rate(z, k4, steady);
        #pragma unroll
        for (int j = 0; j < D; j++) z[j] = y[j] + h * (R(5.325864828439257) * k1[j] + R(-11.748883564062828) * k2[j] + R(7.4955393428898365) * k3[j] + R(-0.09249506636175525) * k4[j]);
        S::rate(z, k5, steady);
        #pragma unroll
        for (int j = 0; j < D; j++) z[j] = y[j] + h * (R(5.86145544294642) * k1[j] + R(-12.92096931784711) * k2[j] + R(8.159367898576159) * k3[j] + R(-0.071584973281401) * k4[j] + R(-0.028269050394068383) * k5[j]);
        S::rate(z, k6, steady);
        #pragma unroll
        for (int j = 0; j < D; j++) z[j] = y[j] + h * (R(0.09646076681806523) * k1[j] + R(0.01) * k2[j] + R(0.4798896504144996) * k3[j] + R(1.379008574103742) * k4[j] + R(-3.290069515436081) * k5[j] + R(2.324710524099774) * k6[j]);
        S::rate(z, k7, steady);
        R worst = 0;
        #pragma unroll
        for (int j = 0; j < D; j++) {
            const R e = h * (R(0.00178001105222577714) * k1[j] + R(0.0008164344596567469) * k2[j] + R(-0.007880878010261995) * k3[j] + R(0.1447110071732629) * k4[j] + R(-0.5823571654525552) * k5[j] + R(0.45808210592918697) * k6[j] + R(-0.015151515151515152) * k7[j]);
            const R scale = rtol + rtol * fmax(fabs(y[j]), fabs(z[j]));
            worst = fmax(worst, fabs(e) / scale);
        }
        taken++;
        worst = fmax(worst, R(1e-6));
        // The PI control of Hairer, Norsett and Wanner, as DiffEqGPU and others have it. It needs no
        // more digits than f32 has, and pow in f64 would cost as much as the step.
        float factor;
        if (worst <= 1) {
            t += h;
            #pragma unroll
            for (int j = 0; j < D; j++) { y[j] = z[j]; k1[j] = k7[j]; }
            factor = 0.9f * exp2f(-0.7f / 5 * log2f(float(worst)) + 0.4f / 5 * log2f(before));
            before = fmaxf(float(worst), 1e-4f);
        } else {
            factor = 0.9f * exp2f(-0.2f * log2f(float(worst)));
        }
        h *= R(fminf(10.0f, fmaxf(0.2f, factor)));
    }
    for (int j = 0; j < D; j++) out[j * n + i] = y[j];
    steps[i] = taken;
}

struct Outcome { std::vector<double> end; double seconds, kernel, steps; };

template <class R, class S> Outcome run(size_t n, double rtol, const std::vector<double>& seeds, int repeats) {
    std::vector<R> host(seeds.begin(), seeds.end()), back(seeds.size());
    std::vector<unsigned> steps(n);
    R *in, *out; unsigned* taken;
    CHECK(cudaMalloc(&in, sizeof(R) * host.size()));
    CHECK(cudaMalloc(&out, sizeof(R) * host.size()));
    CHECK(cudaMalloc(&taken, sizeof(unsigned) * n));
    cudaEvent_t a, b, c, d;
    for (auto e : {&a, &b, &c, &d}) CHECK(cudaEventCreate(e));
    std::vector<std::pair<double, double>> times;
    for (int pass = 0; pass <= repeats; pass++) {
        CHECK(cudaEventRecord(a));
        CHECK(cudaMemcpy(in, host.data(), sizeof(R) * host.size(), cudaMemcpyHostToDevice));
        CHECK(cudaEventRecord(b));
        integrate<R, S><<<unsigned((n + 127) / 128), 128>>>(in, out, taken, n, R(rtol), R(S::TIME), R(S::steady()));
        CHECK(cudaGetLastError());
        CHECK(cudaEventRecord(c));
        CHECK(cudaMemcpy(back.data(), out, sizeof(R) * back.size(), cudaMemcpyDeviceToHost));
        CHECK(cudaMemcpy(steps.data(), taken, sizeof(unsigned) * n, cudaMemcpyDeviceToHost));
        CHECK(cudaEventRecord(d));
        CHECK(cudaEventSynchronize(d));
        float whole, kernel;
        CHECK(cudaEventElapsedTime(&whole, a, d));
        CHECK(cudaEventElapsedTime(&kernel, b, c));
        if (pass > 0) times.push_back({whole * 1e-3, kernel * 1e-3});
    }
    std::sort(times.begin(), times.end());
    double sum = 0;
    for (unsigned s : steps) sum += s;
    for (auto p : {(void*)in, (void*)out, (void*)taken}) CHECK(cudaFree(p));
    return {std::vector<double>(back.begin(), back.end()), times[times.size() / 2].first, times[times.size() / 2].second, sum / double(n)};
}

template <class R, class S> void setting(const char* precision, size_t n, double rtol, const std::vector<double>& seeds, const std::vector<double>& reference) {
    const Outcome o = run<R, S>(n, rtol, seeds, 7);
    std::vector<double> errors(n);
    for (size_t i = 0; i < n; i++)
        for (int j = 0; j < S::DIM; j++) {
            const double shift = j == 0 ? S::SHIFT : 0;
            const double y = o.end[j * n + i] + shift, r = reference[j * n + i] + shift;
            errors[i] = std::max(errors[i], std::fabs(y - r) / std::max(1.0, std::fabs(r)));
        }
    std::sort(errors.begin(), errors.end());
    printf("{\"peer\": \"hand-written CUDA\", \"precision\": \"%s\", \"method\": \"tsit5\", \"setting\": \"rtol=%g\", \"n\": %zu, \"seconds\": %.6f, \"kernel_seconds\": %.6f, \"traj_per_s\": %.0f, \"max_rel_err\": %.2e, \"median_rel_err\": %.2e, \"steps\": %.1f}\n",
        precision, rtol, n, o.seconds, o.kernel, double(n) / o.seconds, errors[n - 1], errors[n / 2], o.steps);
    fflush(stdout);
}

template <class S> void all(size_t n) {
    std::vector<double> seeds(n * S::DIM);
    S::seeds(n, seeds);
    const std::vector<double> reference = run<double, S>(n, 1e-14, seeds, 1).end;
    for (double rtol : {1e-3, 1e-4, 1e-5, 1e-6}) setting<float, S>("f32", n, rtol, seeds, reference);
    for (double rtol : {1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8}) setting<double, S>("f64", n, rtol, seeds, reference);
}

int main(int argc, char** argv) {
    const size_t n = argc > 1 ? strtoull(argv[1], nullptr, 10) : 1048576;
    if (argc > 2 && !strcmp(argv[2], "van_der_pol")) all<VanDerPol>(n);
    else all<Pendulum>(n);
}
