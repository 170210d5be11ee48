// As much of CUDA as the forward kernels of gsplat 1.5.3 use, on the CPU: the threads of a block are fibers that take
// turns at its barriers, the blocks run one after another. What a GPU does otherwise than C++ is done as there: casts
// to integers saturate, min and max of floats drop NaN, and exp and log are those of nvcc's -use_fast_math.
#pragma once
#include <math.h>
#include <ucontext.h>

#include <algorithm>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <type_traits>
#include <vector>

#define __global__
#define __device__
#define __shared__ static

struct dim3 {
    unsigned x = 1, y = 1, z = 1;
    template <class X> dim3(X x) : x(x) {}
    template <class X, class Y, class Z> dim3(X x, Y y, Z z) : x(x), y(y), z(z) {}
    size_t count() const { return size_t(x) * y * z; }
    dim3 at(size_t rank) const { return {rank % x, rank / x % y, rank / x / y}; }
};
struct uint2 { unsigned x, y; };

namespace cuda_on_cpu {

struct Fiber {
    ucontext_t context;
    std::unique_ptr<char[]> stack = std::make_unique<char[]>(SIZE);
    bool finished;
    int brought;  // to the barrier
    int before;   // the sum of what threads of a lower rank brought
    static constexpr size_t SIZE = 128 * 1024;
};

inline dim3 grid_size = 1, block_size = 1, block_index = 0;
inline size_t rank;  // of the running thread in its block
inline int total;    // of what the threads brought to the last barrier
inline std::vector<Fiber> fibers;
inline ucontext_t scheduler;
inline const std::function<void()> *kernel;
inline std::vector<char> dynamic_shared;

inline void run_thread() {
    (*kernel)();
    fibers[rank].finished = true;
}

// Waits until every thread of the block that still runs is here; the sum of what they brought.
inline int barrier(int value) {
    Fiber &fiber = fibers[rank];
    fiber.brought = value;
    swapcontext(&fiber.context, &scheduler);
    return total;
}

inline void run_block() {
    const size_t count = block_size.count();
    if (fibers.size() < count) fibers = std::vector<Fiber>(count);
    for (size_t k = 0; k < count; ++k) {
        Fiber &fiber = fibers[k];
        getcontext(&fiber.context);
        fiber.context.uc_stack.ss_sp = fiber.stack.get();
        fiber.context.uc_stack.ss_size = Fiber::SIZE;
        fiber.context.uc_link = &scheduler;
        fiber.finished = false;
        makecontext(&fiber.context, run_thread, 0);
    }
    for (bool running = true; running;) {
        running = false;
        for (rank = 0; rank < count; ++rank) {
            fibers[rank].brought = 0;
            if (fibers[rank].finished) continue;
            swapcontext(&scheduler, &fibers[rank].context);
            running |= !fibers[rank].finished;
        }
        total = 0;
        for (size_t k = 0; k < count; ++k) {
            fibers[k].before = total;
            total += fibers[k].brought;
        }
    }
}

// kernel<<<grid, block, shared_bytes, stream>>>(...)
inline void launch(dim3 grid, dim3 block, size_t shared_bytes, int, const std::function<void()> &body) {
    static std::mutex one_at_a_time;
    const std::lock_guard lock(one_at_a_time);
    grid_size = grid, block_size = block, kernel = &body;
    for (size_t k = 0; k < grid.count(); ++k) {
        block_index = grid.at(k);
        dynamic_shared.assign(shared_bytes, char(0xCB));  // what is read before it is written is to be seen
        run_block();
    }
}

template <class To> To saturate(double value) {
    using Limits = std::numeric_limits<To>;
    if (std::isnan(value)) return 0;
    return To(std::clamp(value, double(Limits::min()), double(Limits::max())));
}

}  // namespace cuda_on_cpu

#define threadIdx (cuda_on_cpu::block_size.at(cuda_on_cpu::rank))
#define blockIdx cuda_on_cpu::block_index
#define blockDim cuda_on_cpu::block_size
#define gridDim cuda_on_cpu::grid_size

inline int __syncthreads_or(int value) { return cuda_on_cpu::barrier(value != 0) != 0; }
inline int __syncthreads_count(int value) { return cuda_on_cpu::barrier(value != 0); }
inline float __expf(float x) { return exp2f(x * 1.4426950408889634f); }
inline float __logf(float x) { return log2f(x) * 0.6931471805599453f; }
inline float rsqrtf(float x) { return 1.0f / sqrtf(x); }
inline float rsqrt(float x) { return rsqrtf(x); }
template <class A, class B> auto min(A a, B b) {
    using T = std::common_type_t<A, B>;
    if constexpr (std::is_floating_point_v<T>) return T(fmin(a, b));
    else return std::min<T>(a, b);
}
template <class A, class B> auto max(A a, B b) {
    using T = std::common_type_t<A, B>;
    if constexpr (std::is_floating_point_v<T>) return T(fmax(a, b));
    else return std::max<T>(a, b);
}

namespace cooperative_groups {
struct Block {
    static dim3 group_index() { return blockIdx; }
    static dim3 thread_index() { return threadIdx; }
    static unsigned size() { return blockDim.count(); }
    static unsigned thread_rank() { return cuda_on_cpu::rank; }
    static void sync() { cuda_on_cpu::barrier(0); }
};
struct Grid {
    static unsigned thread_rank() { return blockIdx.x * blockDim.x + threadIdx.x; }
};
inline Block this_thread_block() { return {}; }
inline Grid this_grid() { return {}; }
// Named by the backward kernels' helpers, which nothing calls here.
template <class T> struct plus {};
template <class T> struct greater {};
template <class Group, class T, class Operation> T reduce(Group &, T, Operation);
}  // namespace cooperative_groups

namespace cub {
template <class T, int THREADS> struct BlockReduce {
    struct TempStorage {};
    explicit BlockReduce(TempStorage &) {}
    T Sum(T value) { return cuda_on_cpu::barrier(value); }
};
template <class T, int THREADS> struct BlockScan {
    struct TempStorage {};
    explicit BlockScan(TempStorage &) {}
    void ExclusiveSum(T value, T &sum) {
        cuda_on_cpu::barrier(value);
        sum = cuda_on_cpu::fibers[cuda_on_cpu::rank].before;
    }
};
template <class T> struct DoubleBuffer {
    T *from, *to;
    int selector = 0;
};
struct DeviceRadixSort {
    template <class Key, class Value>
    static void SortPairs(void *storage, size_t &bytes, DoubleBuffer<Key> &keys, DoubleBuffer<Value> &values,
                          int64_t count, int first_bit, int end_bit, int) {
        bytes = 1;
        if (!storage) return;
        const auto digits = [&](int64_t k) { return uint64_t(keys.from[k]) << (64 - end_bit) >> (64 - end_bit + first_bit); };
        std::vector<int64_t> order(count);
        for (int64_t k = 0; k < count; ++k) order[k] = k;
        std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return digits(a) < digits(b); });
        for (int64_t k = 0; k < count; ++k) {
            keys.to[k] = keys.from[order[k]];
            values.to[k] = values.from[order[k]];
        }
        keys.selector = values.selector = 1;
    }
};
struct DeviceSegmentedRadixSort {
    template <class... Arguments> static void SortPairs(Arguments &&...) { throw std::logic_error("segmented sort"); }
};
}  // namespace cub

namespace at::cuda {
inline int getCurrentCUDAStream() { return 0; }
struct OptionalCUDAGuard {
    template <class Device> explicit OptionalCUDAGuard(Device) {}
};
}  // namespace at::cuda

namespace c10::cuda::CUDACachingAllocator {
struct Host {
    std::unique_ptr<char[]> allocate(size_t bytes) { return std::make_unique<char[]>(bytes); }
};
inline Host *get() {
    static Host host;
    return &host;
}
}  // namespace c10::cuda::CUDACachingAllocator

inline constexpr int cudaSuccess = 0, cudaFuncAttributeMaxDynamicSharedMemorySize = 0;
template <class Kernel> int cudaFuncSetAttribute(Kernel, int, int64_t) { return cudaSuccess; }
