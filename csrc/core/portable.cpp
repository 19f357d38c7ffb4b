// Lets a module from a newer compiler run on the systems that manylinux_2_28 promises: glibc 2.28
// and the libstdc++ of GCC 8. Newer headers would ask these libraries for names that they lack.
// These names are defined here, for this module alone: exports.map hides them. The last such name,
// exp, is in kernels/math.h.
#include <exception>
#include <new>
#include <sstream>

// C++20's str() const&, str() && and default constructors. The error messages of torch use them.
template class std::__cxx11::basic_stringbuf<char>;
template class std::__cxx11::basic_ostringstream<char>;
template class std::__cxx11::basic_stringstream<char>;

// Called if std::allocator is asked for more bytes than there are addresses.
void std::__throw_bad_array_new_length() { throw std::bad_array_new_length(); }

// From GCC 11: the two halves of copying an exception_ptr. Older libraries have the whole copy,
// which adds a reference, and the destructor, which removes one.
extern "C" {
void copy_exception(void**, void* const*) __asm__("_ZNSt15__exception_ptr13exception_ptrC1ERKS0_");
void destroy_exception(void**) __asm__("_ZNSt15__exception_ptr13exception_ptrD1Ev");
}
void std::__exception_ptr::exception_ptr::_M_addref() noexcept {
  void* copy = nullptr;
  copy_exception(&copy, &_M_exception_object);
}
void std::__exception_ptr::exception_ptr::_M_release() noexcept {
  destroy_exception(&_M_exception_object);
  _M_exception_object = nullptr;
}

// From glibc 2.32: tells whether std::shared_ptr may count without atomics. 0 means that it may
// not.
extern "C" {
char __libc_single_threaded = 0;
}
