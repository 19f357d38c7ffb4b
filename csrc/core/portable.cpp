// Lets a module from a newer compiler run on the systems that manylinux_2_28 promises: glibc 2.28
// and the libstdc++ of GCC 8. Newer headers would ask these libraries for names that they lack.
// These names are defined here, for this module alone: exports.map hides them. The last such name,
// exp, is in kernels/math.h. Systems with other libraries, such as macOS, need none of this.
//
// Only modules have these definitions (CMakeLists.txt). A program has no exports.map: its own would
// take the place of the library's, which calls them, and they would call themselves without end.
// Those that a library calls are hidden for the same reason.
#include <exception>
#include <new>
#include <sstream>

#if defined(DARSWIN_MODULE) && defined(__GLIBCXX__) && defined(__GLIBC__)

// C++20's str() const&, str() && and default constructors. The error messages of torch use them.
template class std::__cxx11::basic_stringbuf<char>;
template class std::__cxx11::basic_ostringstream<char>;
template class std::__cxx11::basic_stringstream<char>;

#  if _GLIBCXX_RELEASE >= 11
// Called if std::allocator is asked for more bytes than there are addresses.
void std::__throw_bad_array_new_length() { throw std::bad_array_new_length(); }
__asm__(".hidden _ZSt28__throw_bad_array_new_lengthv");

// The two halves of copying an exception_ptr. Older libraries have the whole copy, which adds a
// reference, and the destructor, which removes one. The version says that the library's are meant:
// the module may have copies of its own, from the headers, which call these halves.
extern "C" {
void copy_exception(void**, void* const*);
void destroy_exception(void**);
}
__asm__(".symver copy_exception, _ZNSt15__exception_ptr13exception_ptrC1ERKS0_@CXXABI_1.3.3");
__asm__(".symver destroy_exception, _ZNSt15__exception_ptr13exception_ptrD1Ev@CXXABI_1.3.3");
void std::__exception_ptr::exception_ptr::_M_addref() noexcept {
  void* copy = nullptr;
  copy_exception(&copy, &_M_exception_object);
}
void std::__exception_ptr::exception_ptr::_M_release() noexcept {
  destroy_exception(&_M_exception_object);
  _M_exception_object = nullptr;
}
__asm__(".hidden _ZNSt15__exception_ptr13exception_ptr9_M_addrefEv");
__asm__(".hidden _ZNSt15__exception_ptr13exception_ptr10_M_releaseEv");
#  endif

// From glibc 2.32: tells whether std::shared_ptr may count without atomics. 0 means that it may
// not.
extern "C" {
char __libc_single_threaded = 0;
}
__asm__(".hidden __libc_single_threaded");
#endif
