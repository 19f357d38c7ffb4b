// Lets a module that a newer compiler made run where manylinux_2_28 promises to: on glibc 2.28 and
// libstdc++ of GCC 8. What the headers of newer ones would ask these libraries for is defined here,
// for this module alone: exports.map hides it. The last such name, exp, is in kernels/math.h.
#include <new>
#include <sstream>

// C++20's str() const&, str() && and default constructors, which torch's messages of errors use.
template class std::__cxx11::basic_stringbuf<char>;
template class std::__cxx11::basic_ostringstream<char>;
template class std::__cxx11::basic_stringstream<char>;

// Where std::allocator is asked for more bytes than there are addresses.
void std::__throw_bad_array_new_length() { throw std::bad_array_new_length(); }

// From glibc 2.32: whether std::shared_ptr may count without atomics. 0 says that it may not.
extern "C" {
char __libc_single_threaded = 0;
}
