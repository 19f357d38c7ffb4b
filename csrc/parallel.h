// What both drivers need to be fast and still give the same bits for any number of threads: OpenMP
// over contiguous ranges, and a sum of per-image rows in a fixed order.
#pragma once

#include <omp.h>
#if defined(__linux__)
#  include <sys/mman.h>
#endif
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#include <vector>

namespace darswin {

inline int64_t num_threads(int64_t count) {
  return std::clamp<int64_t>(count, 1, torch::stable::get_num_threads());
}

// body(begin, end, thread) with thread < num_threads(count). It must not throw.
template <typename Body>
void parallel_ranges(int64_t count, Body&& body) {
  if (count == 0) return;
  const int64_t threads = num_threads(count);
#pragma omp parallel num_threads(threads) if (threads > 1)
  {
    const int64_t thread = omp_get_thread_num(), team = omp_get_num_threads();
    const int64_t each = count / team, extra = count % team;
    const int64_t begin = thread * each + std::min(thread, extra);
    const int64_t end = begin + each + (thread < extra ? 1 : 0);
    if (begin < end) body(begin, end, thread);
  }
}

// This thread's working memory: at least `bytes`, aligned to cache lines, contents undefined. It is
// kept from call to call, since fresh pages cost more than what the kernels do with them; a second
// call of scratch() in the same thread hands out the same memory.
inline void* scratch(size_t bytes) {
  struct Free {
    void operator()(void* memory) const { std::free(memory); }
  };
  static thread_local std::unique_ptr<void, Free> memory;
  static thread_local size_t size = 0;
  if (size < bytes) {
    memory.reset();
    size = (bytes + 4095) / 4096 * 4096;
    memory.reset(std::aligned_alloc(64, size));
    if (memory == nullptr) throw std::bad_alloc();
  }
  return memory.get();
}

// Memory that is new from the system costs more to be mapped, page by page, than to be written.
// Large pages cost less. Below 32 MB glibc hands out memory that it has kept, already mapped.
inline void ask_for_large_pages(const torch::stable::Tensor& tensor) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  constexpr uintptr_t kPage = 4096, kLeast = uintptr_t{32} << 20;
  const auto begin = reinterpret_cast<uintptr_t>(tensor.mutable_data_ptr());
  const uintptr_t end = begin + tensor.numel() * tensor.element_size();
  const uintptr_t first = (begin + kPage - 1) / kPage * kPage;
  if (end - begin < kLeast) return;
  madvise(reinterpret_cast<void*>(first), (end - first) / kPage * kPage, MADV_HUGEPAGE);
#else
  (void)tensor;
#endif
}

// The gradient of `like`, (B or 1, ...), from one row of doubles an image: summed over the images
// where they share one row.
template <typename T>
torch::stable::Tensor fold_rows(const torch::stable::Tensor& like,
                                const std::vector<double>& rows) {
  const torch::stable::Tensor folded = torch::stable::new_zeros(like, like.sizes());
  std::vector<double> sums(folded.numel(), 0.0);
  for (size_t k = 0; k < rows.size(); ++k) sums[k % sums.size()] += rows[k];
  T* to = folded.template mutable_data_ptr<T>();
  for (size_t k = 0; k < sums.size(); ++k) to[k] = static_cast<T>(sums[k]);
  return folded;
}

}  // namespace darswin
