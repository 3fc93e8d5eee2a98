/* Windows hands out stack page by page: a function with a large frame first touches each page in turn, by a call of
 * `___chkstk_ms` with the size in rax, which keeps all registers. zig's runtime has one, beside 40 kB that nobody calls
 * and the linker keeps; with this one the library does without that runtime (`-rtlib=none`). */
#ifndef SN_PROBE_H
#define SN_PROBE_H

__asm__(".text\n"
        ".globl ___chkstk_ms\n"
        "___chkstk_ms:\n"
        "    pushq %rax\n"
        "    pushq %rcx\n"
        "    leaq 24(%rsp), %rcx\n" /* the caller's stack pointer */
        "1:  cmpq $4096, %rax\n"
        "    jb 2f\n"
        "    subq $4096, %rcx\n"
        "    testb %al, (%rcx)\n"
        "    subq $4096, %rax\n"
        "    jmp 1b\n"
        "2:  subq %rax, %rcx\n"
        "    testb %al, (%rcx)\n"
        "    popq %rcx\n"
        "    popq %rax\n"
        "    ret\n");

#endif
