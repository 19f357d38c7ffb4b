// Pieces of a thread's working memory. Under AddressSanitizer, a forbidden gap follows each piece,
// so that the sanitizer reports every access beyond the end of a piece.
#pragma once

#include <cstdint>
#if defined(__SANITIZE_ADDRESS__)
#  include <sanitizer/asan_interface.h>
#endif

namespace darswin {
namespace {

// Hands out pieces of a block of memory and counts their bytes. Without a block it only counts.
struct Arena {
  char* memory;
  int64_t used = 0;

  template <typename T>
  T* take(int64_t count) {
    char* piece = memory == nullptr ? nullptr : memory + used;
    const int64_t bytes = count * static_cast<int64_t>(sizeof(T));
    used += (bytes + 63) / 64 * 64;
#if defined(__SANITIZE_ADDRESS__)
    used += 64;
    if (piece != nullptr) ASAN_POISON_MEMORY_REGION(piece + bytes, memory + used - piece - bytes);
#endif
    return reinterpret_cast<T*>(piece);
  }
};

}  // namespace
}  // namespace darswin
