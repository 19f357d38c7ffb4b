// Copies an exception. Linked with csrc/core/portable.cpp, for programs that contain the core.
#include <cstdio>
#include <exception>
#include <stdexcept>

int main() {
  std::exception_ptr first;
  try {
    throw std::runtime_error("copied");
  } catch (...) {
    first = std::current_exception();
  }
  const std::exception_ptr second = first;
  first = nullptr;
  try {
    std::rethrow_exception(second);
  } catch (const std::exception& error) {
    std::puts(error.what());
  }
}
